// The live rig in 3D: its volume, where the object is and has been, and each camera in the tone of its state.

const { add, dot, cross, unit, mean } = Viewer.vectors;

function boxCorners(low, high) {
  const corners = [];
  for (let i = 0; i < 8; i++) corners.push([i & 1 ? high[0] : low[0], i & 2 ? high[1] : low[1], i & 4 ? high[2] : low[2]]);
  return corners;
}

class LiveRig extends Viewer {
  points() { return [...boxCorners(page.layout.low, page.layout.high), ...page.layout.cameras.flat()]; }
  pick(name) { choose(page.hello.cameras.indexOf(name)); }
  refresh() { if (page.layout && page.hello) this.orient(page.layout.up, page.layout.ahead); }

  show(width, height) {
    this.drawVolume();
    this.drawObject();
    const cameras = page.layout.cameras.map((corners, i) => ({ name: page.hello.cameras[i], i, corners: corners.map(this.place) }));
    for (const camera of cameras) camera.at = camera.corners[0];
    const near = [...cameras].sort((a, b) => a.at[2] - b.at[2]);
    for (const camera of [...near].reverse()) this.drawCamera(camera);
    this.drawNames(near, width, height);
    this.spots = cameras;
    const words = {};
    page.hello.cameras.forEach((_, i) => { words[wordOf(i)] = (words[wordOf(i)] || 0) + 1; });
    const counts = Object.entries(words).map(([word, count]) => `${count} ${word}`).join(", ");
    const label = `The rig in 3D, ${plural(cameras.length, "camera")}: ${counts}. Arrow keys turn it, Home puts it at rest.`;
    if (this.canvas.getAttribute("aria-label") !== label) this.canvas.setAttribute("aria-label", label);
  }

  drawVolume() {
    const corners = boxCorners(page.layout.low, page.layout.high), { up } = page.layout, at = corners.map(this.place);
    const heights = corners.map((c) => dot(c, up)), middle = (Math.min(...heights) + Math.max(...heights)) / 2;
    for (let a = 0; a < 8; a++) for (const bit of [1, 2, 4]) if (!(a & bit)) this.stroke([at[a], at[a | bit]], "--ghost", 1, 0.55);
    const floor = at.filter((_, i) => heights[i] < middle);
    if (floor.length === 4) this.fill([floor[0], floor[1], floor[3], floor[2]], "--ghost", 0.1);
  }

  drawObject() {
    const next = target(), points = page.state && page.state.object;
    for (const p of page.volume ? page.volume.visited : []) this.disc(this.place(p), 1.6, "--after", 0.28);
    if (points) {
      const middle = this.place(mean(points)), faint = page.layout.cameras.length > 24 ? 0.12 : 0.22;
      page.layout.cameras.forEach(([centre], i) => {
        if (!page.state.sees[i]) return;
        const colour = toneOf(i) === "good" ? "--after" : this.tone(i);
        this.stroke([this.place(centre), middle], colour, 1, i === page.selected ? 0.8 : faint);
      });
      if (next) { this.g.setLineDash([4, 5]); this.stroke([middle, this.place(next)], "--before", 1.4); this.g.setLineDash([]); }
      for (const p of points) this.disc(this.place(p), points.length > 30 ? 1.5 : 2.4, "--ink");
    }
    if (next) {
      const at = this.place(next);
      this.disc(at, 2, "--before");
      this.g.beginPath(); this.g.arc(at[0], at[1], 8, 0, 7); this.g.strokeStyle = this.colour("--before"); this.g.lineWidth = 2; this.g.stroke();
    }
  }

  tone(i) { return toneOf(i) === "none" ? "--ghost" : `--${toneOf(i)}`; }

  drawCamera({ i, corners: [apex, ...rim] }) {
    const tone = this.tone(i), chosen = i === page.selected, mark = chosen ? "--ink" : tone;
    const sides = rim.map((p, k) => [apex, p, rim[(k + 1) % 4]]).sort((a, b) => b[1][2] + b[2][2] - a[1][2] - a[2][2]);
    for (const side of sides) { this.fill(side, tone); this.stroke([...side, side[0]], "--panel", 1); }
    this.fill(rim, "--panel", 0.35);
    this.stroke([...rim, rim[0]], mark, chosen ? 2.2 : 1.2);
    this.disc(apex, chosen ? 4.2 : 3, mark);
  }

  drawNames(near, width, height) { // what is not well before all others, then the nearest cameras
    const names = page.hello.cameras, prefix = names.length > 16 ? COMMON() : "", middle = mean(near.map(({ at }) => at));
    const rank = ({ i }) => (i === page.selected ? 0 : toneOf(i) === "bad" || toneOf(i) === "caution" ? 1 : 2);
    const bodies = near.map(({ corners }) => [0, 1].map((k) => corners.map((p) => p[k])));
    const taken = bodies.map(([xs, ys]) => [Math.min(...xs) + 1, Math.min(...ys) + 1, Math.max(...xs) - 1, Math.max(...ys) - 1]);
    const labels = [...near].sort((a, b) => rank(a) - rank(b)).map((camera) => {
      const full = camera.name.slice(prefix.length), [x, y] = camera.at;
      const colour = ["--ink", this.tone(camera.i), "--muted"][rank(camera)];
      return { name: full.length > 16 ? full.slice(0, 15) + "…" : full, at: camera.at, away: Math.atan2(y - middle[1], x - middle[0]), colour };
    });
    this.names(labels, taken, width, height, names.length > 24 ? 11 : 12.5);
  }
}

const liveRig = new LiveRig($("scene"));
