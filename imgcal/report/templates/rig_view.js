// The rigs of a report in 3D, with a grid, axes, and the object. Scenes come from `rig_scene`.
const RigView = (() => {
  const {dot} = Viewer.vectors;
  function niceStep(raw) {
    const power = 10 ** Math.floor(Math.log10(raw));
    return Number(([1, 2, 5, 10].find((digit) => digit * power >= raw * 0.999) * power).toPrecision(3));
  }
  function mixed(share) { // from the first group to the last: blue, purple, amber; on light and on dark
    const stops = [[79, 131, 232], [184, 96, 196], [240, 160, 48]];
    const [i, part] = share < 0.5 ? [0, 2 * share] : [1, 2 * share - 1];
    return `rgb(${stops[i].map((value, k) => Math.round(value + part * (stops[i + 1][k] - value))).join(",")})`;
  }

  return class RigView extends Viewer {
    set(scene, step = 0) {
      this.scene = scene;
      this.step = step;
      this.orient(scene.up, scene.forward);
    }
    points() {
      const points = this.scene.groups.flat();
      for (const rig of this.scene.rigs) for (const camera of this.poses(rig)) points.push(...camera);
      return points;
    }
    poses(rig) { // of each camera: centre, and the corners of its view from the top left one
      return rig.steps[Math.min(this.step, rig.steps.length - 1)];
    }
    near(depth) { // 1 in front, less behind
      return Math.min(Math.max(0.72 - 0.28 * depth / this.radius, 0.35), 1);
    }

    show(width, height) {
      this.grid(height);
      const [cameras, dots] = [this.cameras(), this.dots()];
      this.spots = [...cameras, ...dots];
      for (const part of [...this.spots].sort((a, b) => b.at[2] - a.at[2])) part.paint();
      this.shifts();
      const named = cameras.filter((camera) => camera.named).sort((a, b) => a.at[2] - b.at[2]);
      this.names(named, [[0, height - 70, 160, height]], width, height); // the axes are in that corner
      this.axes(height);
    }

    // A level grid under everything, as wide as everything; its step is written beside it.
    grid(height) {
      const {up, forward, right} = this.basis;
      const all = this.points();
      const bounds = [forward, right, up].map((axis) => { const at = all.map((p) => dot(p, axis)); return [Math.min(...at), Math.max(...at)]; });
      const [, , [low]] = bounds;
      const step = niceStep(Math.max(...bounds.slice(0, 2).map(([a, b]) => b - a), 1e-6) / 5);
      const [fs, rs] = bounds.map(([a, b]) => [Math.floor(a / step), Math.ceil(b / step)]);
      const at = (i, j) => this.place(up.map((_, k) => low * up[k] + i * step * forward[k] + j * step * right[k]));
      for (let i = fs[0]; i <= fs[1]; i += 1) this.stroke([at(i, rs[0]), at(i, rs[1])], "--line", 1);
      for (let j = rs[0]; j <= rs[1]; j += 1) this.stroke([at(fs[0], j), at(fs[1], j)], "--line", 1);
      this.text(`grid ${step >= 1000 ? `${step / 1000} m` : `${step} mm`}`, 70, height - 14, "--muted");
    }
    cameras() {
      const last = this.scene.rigs.length - 1;
      return this.scene.rigs.flatMap((rig, number) => this.poses(rig).map((corners, c) => {
        const name = this.scene.names[c];
        const tone = number > 0 || last === 0 ? (this.scene.tones || {})[name] : undefined;
        const [apex, a, b, cc, d] = corners.map(this.place);
        const colour = tone || rig.colour;
        const alpha = this.near(apex[2]) * (rig.filled ? 1 : 0.8);
        const up = [1.25 * (a[0] + b[0]) / 2 - 0.25 * (cc[0] + d[0]) / 2, 1.25 * (a[1] + b[1]) / 2 - 0.25 * (cc[1] + d[1]) / 2];
        return {
          name, at: apex, named: number === last, away: Math.atan2(apex[1] - (a[1] + cc[1]) / 2, apex[0] - (a[0] + cc[0]) / 2),
          paint: () => {
            if (rig.filled) {
              for (const side of [[apex, a, b], [apex, b, cc], [apex, cc, d], [apex, d, a]]) this.fill(side, colour, 0.1);
              this.fill([a, up, b], colour, alpha);
            }
            this.stroke([a, b, cc, d, a], colour, rig.filled ? 1.6 : 1.1, alpha);
            for (const corner of [a, b, cc, d]) this.stroke([apex, corner], colour, rig.filled ? 1.2 : 0.9, 0.8 * alpha);
          },
        };
      }));
    }
    shifts() { // from where each camera of the first rig was to where it is in the last
      const [first, last] = [this.scene.rigs[0], this.scene.rigs[this.scene.rigs.length - 1]];
      if (first === last) return;
      const now = this.poses(last);
      this.poses(first).forEach((camera, c) => {
        const [from, to] = [this.place(camera[0]), this.place(now[c][0])];
        if (Math.hypot(to[0] - from[0], to[1] - from[1]) > 2) this.stroke([from, to], "--before", 3);
      });
    }
    dots() {
      const {groups, groupNames = [], fiducials = []} = this.scene;
      const count = groups.reduce((sum, group) => sum + group.length, 0);
      const size = count < 200 ? 3 : count < 1500 ? 2.2 : 1.3;
      return groups.flatMap((group, i) => {
        const colour = mixed(groups.length > 1 ? i / (groups.length - 1) : 0);
        return group.map((point, fiducial) => {
          const at = this.place(point);
          const name = `fiducial ${fiducials[fiducial] ?? fiducial}${groupNames[i] ? `, ${groupNames[i]}` : ""}`;
          return {name, at, paint: () => this.disc(at, size, colour, this.near(at[2]))};
        });
      });
    }
    axes(height) {
      const [x, y] = [34, height - 34];
      const {across, upwards} = this.directions;
      ["x", "y", "z"].forEach((name, i) => {
        const [dx, dy] = [across[i], -upwards[i]];
        this.stroke([[x, y], [x + 20 * dx, y + 20 * dy]], "--muted", 1.4);
        this.text(name, x + 27 * dx, y + 27 * dy, "--muted", {align: "center"});
      });
    }
  };
})();
