"""The options of every command, their defaults, and the words of its help.

Nothing here imports a numerical library, so help, completion and a mistyped option are answered at once. The command
of the same name takes these values and runs.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

import tyro

from imgcal.detection import DetectionOptions
from imgcal.errors import InputError
from imgcal.formats import LIMIT
from imgcal.synthesis import HandHeld, Lens, PhysicalDrift, Shape
from imgcal.watch import Timing
from renderers import ClutterModel, SensorModel

Level = Literal["clean", "low-light", "motion-blur", "clutter", "defocus", "combined", "half-hidden", "uneven"]
StartPose = tuple[float, float, float, float, float, float]
Axis = Literal["kappa", "phi", "noise", "missing", "swapped", "false"]


@dataclass(frozen=True)
class Simulate:
    """Make a capture: infrared frames of a rig that has drifted from its factory calibration.

    Writes OUT/frames/<camera>/<snapshot>.png, the factory rig and the object beside them, and OUT/truth/ with the
    drifted rig, the exact image points (labelled), the object's poses, and how much of each marker is visible
    (seen.csv). By default, each camera drifts by half a degree, 2 mm, 1 % of its focal length and 5 px (one standard
    deviation: --physical.*). --difficulty makes frames dim, blurred, out of focus or cluttered.

    For example:
        imgcal simulate --rig O10 --object asymmetric8 --out my_capture --snapshots 20
        imgcal simulate --rig room10 --object wand4 --out wand --snapshots 100 --poses hand-held --exposure-ms 2
    """

    rig: str  #: factory rig: a file, or the name of a shipped one (O10, O6, U7, T4, room10)
    object: tuple[str, ...]
    """object: a file, or the name of a shipped one (asymmetric8, cube8, cube27, sphere64, wand4; printed boards:
    charuco, aprilgrid, checkerboard, circles); several that move independently: --object A B; lights = a body with
    unknown markers (--lights)"""
    out: Path  #: folder to write; must not hold a capture yet
    lights: int | None = None  #: number of markers on the body, with --object lights; default: 15
    snapshots: int = 10  #: number of poses of the object
    seed: int = 0  #: the same seed gives the same capture
    drift: Literal["physical", "relative", "none"] | None = None
    """physical = in degrees, mm and pixels (the default); relative = value * (1 + delta), as in the paper (--kappa)"""
    kappa: float | None = None
    """largest relative change of intrinsics, positions and Euler angles, as in the paper; 0.025 with --drift relative.
    Cameras that face each other have large Euler angles, and turn far"""
    physical: PhysicalDrift = field(default_factory=PhysicalDrift)  # standard deviations for --drift physical
    poses: Literal["hemisphere", "volume", "hand-held"] | None = None
    """where the object is: hemisphere = turned, at the rig's working_distance, in view of every camera (as in the
    paper); volume = anywhere in the rig's volume, in view of some cameras; hand-held = on a smooth path through the
    volume. Default: hemisphere if the rig file has a working_distance and no volume, else volume"""
    hand: Annotated[HandHeld, tyro.conf.arg(name="")] = field(default_factory=HandHeld)
    exposure_ms: float = 0.0  #: ms; the motion of a hand-held object blurs its markers during this time
    theta_deg: tuple[float, float] = (0.0, 360.0)  #: range of the rig's azimuth around the object, for hemisphere
    phi_deg: tuple[float, float] = (0.0, 90.0)  #: range of the rig's angle from the object's z axis, for hemisphere
    alpha_deg: tuple[float, float] = (0.0, 360.0)  #: range of the rig's roll, for hemisphere
    marker_radius: float = 6.0  #: mm, for objects whose file gives no radius
    clutter: bool = True  #: reflections, false blobs, partly hidden markers
    difficulty: Level | None = None  #: preset of light and clutter; it replaces the options below
    sensor: SensorModel = field(default_factory=SensorModel)
    clutter_model: ClutterModel = field(default_factory=ClutterModel)


@dataclass(frozen=True)
class LookAt:
    """Make a rig of equal cameras in a ring, a dome or a row that all look at one point; z points up.

    For example:
        imgcal rig look-at --shape ring --cameras 8 --radius 4000 --height 2500 --target 0 0 1000 --out ring8.yaml
    """

    out: Path  #: rig file to write
    shape: Shape = "ring"
    """ring = on a circle about the z axis; dome = over a half sphere; row = on a line along x"""
    cameras: int = 8  #: number of cameras
    radius: float = 4000.0  #: mm, of the circle or sphere; half the length of a row
    height: float = 2500.0  #: mm, z of the circle, the row, or the centre of the sphere
    target: tuple[float, float, float] = (0.0, 0.0, 1000.0)  #: mm, the point that all cameras look at
    lens: Annotated[Lens, tyro.conf.arg(name="")] = field(default_factory=Lens)
    volume: tuple[float, float, float, float, float, float] | None = None
    """mm, the box in which the rig is used: smallest x y z, largest x y z; default: around the target"""


@dataclass(frozen=True)
class Cameras:
    """Make a cameras file: image sizes and a rough field of view, for a rig without a factory calibration.

    imgcal calibrate --cameras starts from this file.

    For example:
        imgcal rig cameras my_capture --field-of-view-deg 65 --out cameras.yaml
    """

    capture: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="CAPTURE")]
    """capture folder; gives the names of the cameras and the sizes of their images"""
    field_of_view_deg: float  #: degrees across the longer side of the image, within about 15 %
    out: Path  #: file to write


@dataclass(frozen=True)
class Rig:
    """Make a rig file for a simulation, or a cameras file for a first calibration.

    See imgcal rig look-at --help and imgcal rig cameras --help.
    """

    what: Annotated[
        Annotated[LookAt, tyro.conf.subcommand("look-at", prefix_name=False)]
        | Annotated[Cameras, tyro.conf.subcommand("cameras", prefix_name=False)],
        tyro.conf.arg(name=""),
    ]


@dataclass(frozen=True)
class Detect:
    """Find blobs in captured frames and measure their centres.

    Writes one row per blob: snapshot, camera, u, v, sigma, radius (pixels), and flags: 1 touches the border, 2 merged,
    4 saturated, 8 masked, 32 not a marker (according to --measurer).

    For example:
        imgcal detect my_capture --out detections.csv
    """

    capture: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="CAPTURE")]
    """folder with frames/<camera>/<snapshot>.png"""
    out: Path  #: CSV or CSV.gz to write
    rig: str | None = None  #: rig whose camera names and image sizes the frames must have: a file or a shipped name
    snapshots: str | None = None  #: A:B, numbers in file order from 0, without B; default: all
    videos_differ: bool = False  #: accept videos whose lengths or time stamps differ; match frames by number
    measurer: str | None = None  #: network that measures blobs again: file, folder of a run, or shipped name
    detection: Annotated[DetectionOptions, tyro.conf.arg(name="")] = field(default_factory=DetectionOptions)


@dataclass(frozen=True)
class Calibrate:
    """Recalibrate a rig from captured frames (or a table of blobs) of a known object.

    Writes OUT/rig.yaml (the recalibrated rig, with the standard deviation of every parameter), OUT/result.json and
    OUT/report.html, and OUT/object.csv if the positions of the markers on the object were estimated as well. If the
    data cannot decide, the exit code is 3: result.json and report.html give the reason, no rig.yaml is written, and an
    earlier calibration in OUT moves to OUT/previous. Any other failure leaves OUT as it was.

    For example:
        imgcal calibrate my_capture --rig factory.yaml --object object.csv --out result
        imgcal calibrate my_capture --cameras cameras.yaml --object wand4 --out result
        imgcal calibrate my_capture --rig factory.yaml --object pointer.csv reference.csv --out result
    """

    input: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="INPUT")]
    """capture folder, detections file, or a shipped sample (sample:O10)"""
    object: tuple[str, ...]
    """object: a file, or the name of a shipped one; several: INPUT --object A B; lights = unknown markers: any blob may
    be one, and the scale comes from the factory positions of the cameras"""
    out: Path  #: folder to write
    rig: str | None = None  #: factory rig: a file, or the name of a shipped one; this or --cameras is needed
    cameras: Path | None = None
    """without a factory calibration: a file with each camera's image size and rough focal length or field of view
    (imgcal rig cameras writes one), or a calibration whose camera poses are ignored. Carry the whole object through
    the views that neighbouring cameras share. The first camera defines the rig's frame"""
    distance: tuple[str, str, float] | None = None
    """CAMERA CAMERA MM: the distance between two cameras, which sets the scale with --cameras and a single light or
    --object lights; without it the rig has no scale. The first of the two is the origin of the rig's frame, the second
    lies on its x axis"""
    snapshots: str | None = None  #: A:B, numbers in file order from 0, without B; default: all
    videos_differ: bool = False  #: accept videos whose lengths or time stamps differ; match frames by number
    detector: str = "classical"
    """what finds the markers in frames: classical = blobs; matched = the whole pattern at once, for frames too dim,
    blurred or cluttered for blobs (slower); learned = a network for any rig and object; auto = blobs, then matched
    where blobs decide nothing; both = blobs, then learned; or the file or folder of a network of your own"""
    measurer: str | None = None
    """network that measures what the detector found again: a file, the folder of a run, or a shipped name"""
    first_guess: str = "none"  #: start of the fit: none (factory rig), points, vit, cnn (shipped), a file or run
    trust: tuple[str, ...] = ()
    """with --first-guess FILE: your own encoders (package.module:Class) that the file may name; their code is run"""
    without: tuple[str, ...] = ()  #: cameras to leave out, of the rig or of INPUT only
    blind_cameras: bool = False  #: accept cameras that see nothing; they keep their factory values
    after_last_move: bool = False  #: if a camera moved during the capture, use only the snapshots since then
    labelled: Path | None = None
    """file to write all blobs to, with their labels, as a table like the input; flag 16 marks labels that do not
    fit"""
    start_pose: StartPose | None = None
    """rough rig_from_object of the first snapshot: rotation vector (3 numbers, rad), then translation (3, mm); decides
    which way round a symmetric object is"""
    object_tolerance: float = 0.0
    """mm, how far each marker may be from its place in the object file (one standard deviation per coordinate), if the
    file has no column `tolerance`; 0 = exact, unless the images say otherwise"""
    object_scale_tolerance: float = 0.0
    """how wrong the size of the object may be, as a share (one standard deviation; 0.01 is 1 %); 0 = exact"""
    full_covariance: bool = False  #: write the whole covariance matrix to rig.yaml as well
    report: bool = True  #: write report.html
    reference: str | None = None
    """camera to which positions and rotations are relative, in the uncertainty in rig.yaml (default: the first camera)
    and in the report (default: most cameras are assumed not to have moved)"""
    detection: Annotated[DetectionOptions, tyro.conf.arg(name="")] = field(default_factory=DetectionOptions)


@dataclass(frozen=True)
class Watch:
    """Keep a running rig calibrated: learn from every snapshot, and report cameras that move.

    INPUT is what the cameras write or send:
        a folder that is being filled with frames/<camera>/<snapshot>.png, or that holds a video per camera;
        tcp://host:port or ipc://path: frames or blobs from another process through ZeroMQ;
        qtm://host: markers from Qualisys QTM, live or played back;
        lsl://name: blobs through the Lab Streaming Layer;
        -: blobs on standard input, one JSON object a line: {"camera": "cam01", "time": 12.5, "uv": [[u, v], ...]};
        a rosbag2 folder or .mcap file; a table of blobs (.csv, .csv.gz).

    OUT gets rig.yaml (the current rig, replaced in one step), history/ (earlier rigs), events.jsonl (what happened, one
    JSON object a line) and state.json. The same command resumes from state.json, even after a power failure. It ends
    with the input, or at Ctrl-C.

    For example:
        imgcal watch tcp://127.0.0.1:5555 --rig factory.yaml --object object.csv --out out/watch
    """

    input: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="INPUT")]  #: folder, address, file or -
    rig: str  #: factory rig: a file, or the name of a shipped one
    object: tuple[str, ...]
    """object: a file, or the name of a shipped one; lights = any bright markers that move through the volume. The
    markers of a stick, or of several objects, are followed one by one, like lights, and their known distances give the
    scale; then the rig should come from imgcal calibrate"""
    out: Path  #: folder to write
    fresh: bool = False  #: ignore what an earlier run left in OUT and start from the factory rig
    tolerance: float = Timing.tolerance  #: s, largest difference of time stamps within a snapshot
    patience: float = Timing.patience  #: s to wait for a missing camera
    keep_all: bool = False  #: never drop snapshots that come too fast: for recordings that are played live
    rate: float | None = None  #: snapshots per second of a table of blobs; default: 30
    topic: tuple[str, ...] = ()  #: CAMERA=TOPIC, for a recording whose topics do not name the cameras
    videos_differ: bool = False  #: accept videos whose lengths or time stamps differ; match frames by time
    until_idle: float | None = None  #: s without a new frame in the folder after which to end
    remove: bool = False  #: delete the frames of a folder after they have been learned from and the state is saved
    metrics: str | None = None  #: [HOST:]PORT for Prometheus; HOST is 127.0.0.1 if not given
    serve: str | None = None  #: [HOST:]PORT of the live page; HOST is 127.0.0.1 if not given
    poses: tuple[str, ...] = ()
    """where to send the object's pose in each snapshot: FILE.csv, FILE.jsonl, tcp://HOST:PORT (ZeroMQ) or
    igtl://[HOST:]PORT (OpenIGTLink: 3D Slicer, PLUS); its markers, or lights, as 3D points: FILE.c3d, FILE.trc;
    several are allowed"""
    hook: str | None = None
    """command to run for each event, without a shell; the event is its standard input, a line of JSON"""
    detector: str = "classical"  #: what finds the markers in frames, as for imgcal calibrate
    measurer: str | None = None
    """network that measures what the network of --detector finds: a file, the folder of a run, or a shipped name"""
    learn: bool = False
    """with --detector learned: adapt detector and measurer to this rig's own frames while it runs, in a process of the
    lowest priority. Crops of snapshots go to OUT/learning/dataset, some of them held out; training begins after 30
    frames of single cameras and 8 held-out snapshots. Adapted networks are used only if they are better on held-out
    snapshots; an event reports either way. They stay in OUT/learning/adapted, for the next start and for --detector
    and --measurer"""
    detection: Annotated[DetectionOptions, tyro.conf.arg(name="")] = field(default_factory=DetectionOptions)


@dataclass(frozen=True)
class Score:
    """Measure the reprojection error of a fixed rig; only the object's pose in each snapshot is fitted.

    Prints a table on a terminal, and JSON into a file or pipe: median_px, p95_px, rms_px, outliers,
    rms_px_with_outliers, points, snapshots_used, snapshots_rejected, per_camera. All errors are lengths in pixels; the
    RMS is that of OpenCV's calibrateCamera, sqrt(2) times the paper's RE. Outliers are points much farther off than
    most in their camera, such as half-hidden markers; median_px and p95_px include them.

    For example:
        imgcal score my_capture --rig out/rig.yaml --object object.csv --snapshots 20:
    """

    input: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="INPUT")]
    """capture folder, detections file, or a shipped sample (sample:O10)"""
    rig: str  #: rig: a file, or the name of a shipped one
    object: tuple[str, ...]
    """object: a file, or the name of a shipped one; several: INPUT --object A B; lights = unknown markers: any blob may
    be one"""
    json: bool = False  #: print JSON on a terminal as well
    snapshots: str | None = None  #: A:B, numbers in file order from 0, without B; default: all
    videos_differ: bool = False  #: accept videos whose lengths or time stamps differ; match frames by number
    detection: Annotated[DetectionOptions, tyro.conf.arg(name="")] = field(default_factory=DetectionOptions)


@dataclass(frozen=True)
class Render:
    """Redraw captured frames as colour-coded images: a soft dot in its own colour for each fiducial, nothing else.

    Finds and identifies the blobs first; those without a certain identity are not drawn. Writes
    OUT/<camera>/<snapshot>.png.

    For example:
        imgcal render my_capture --rig O10 --object asymmetric8 --out coded --size 224
    """

    input: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="INPUT")]
    """capture folder, detections file, or a shipped sample (sample:O10)"""
    rig: str  #: rig: a file, or the name of a shipped one
    object: str  #: object: a file, or the name of a shipped one
    out: Path  #: folder to write
    size: int = 224  #: pixels, width and height of the images
    dot: float = 1.5  #: pixels of the output, standard deviation of a dot
    snapshots: str | None = None  #: A:B, numbers in file order from 0, without B; default: all
    videos_differ: bool = False  #: accept videos whose lengths or time stamps differ; match frames by number
    detection: Annotated[DetectionOptions, tyro.conf.arg(name="")] = field(default_factory=DetectionOptions)


@dataclass(frozen=True)
class Convert:
    """Convert a rig's calibration between imgcal's rig file and the formats of other tools.

    The content of SOURCE decides what it is. The result is read back and compared with the source on known points in
    every camera. Nothing is guessed; assumptions are printed. docs/formats.md lists the formats.

    For example:
        imgcal convert camchain.yaml --out rig.yaml
        imgcal convert rig.yaml --to kalibr --out camchain.yaml
    """

    source: Annotated[tuple[Path, ...], tyro.conf.Positional, tyro.conf.arg(metavar="SOURCE ...")]
    """a file, a folder, or the files that make up one calibration; an imgcal rig file, or the name of a shipped rig"""
    out: Path
    """file to write; a folder if the format has several files"""
    source_format: Annotated[str | None, tyro.conf.arg(name="from")] = None
    """format of SOURCE; default: recognized by its content"""
    to: str | None = None
    """format to write; default: imgcal if OUT ends in .yaml, or the format of --into"""
    into: tuple[Path, ...] = ()
    """another tool's file, folder or files with the same cameras: OUT is a copy with their numbers replaced"""
    source_rig: str | None = None
    """name of the rig, if SOURCE or --into holds several (COLMAP)"""
    unit: str | None = None
    """unit of SOURCE, if its format does not state it: mm, cm, m, inch, or the length of one unit, such as 417.2mm"""
    distance: tuple[str, str, float] | None = None
    """CAMERA CAMERA MM: the distance between two cameras, if the unit is unknown"""
    image_size: tuple[str, ...] = ()
    """WIDTHxHEIGHT of all cameras, or NAME=WIDTHxHEIGHT of one, if SOURCE does not state it"""
    cameras: tuple[str, ...] = ()
    """cameras to keep, in the order to write them; default: all"""
    out_unit: str | None = None
    """unit to write, if the format leaves it open; with --into, the unit of that file"""
    hold_distortion: bool = False
    """write a rig file whose calibrations keep the distortion fixed, so that they can go back into SOURCE"""
    fit_limit: float = LIMIT
    """px, largest error anywhere in the image when a lens is fitted by another lens model"""


@dataclass(frozen=True)
class Export:
    """Write a trained network for another runtime: ONNX, or a torch.export program.

    MODEL is a point network, a query network for infrared frames, or a measurer. The written file is run (ONNX by
    onnxruntime) and compared with PyTorch. docs/runtimes.md describes inputs and outputs.

    For example:
        imgcal export measurer-cnn --to onnx --out measurer.onnx
    """

    model: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="MODEL")]
    """file, folder of a training run, or the name of a shipped network"""
    out: Path  #: file to write
    to: Literal["onnx", "pt2"] = "onnx"  #: pt2 = a torch.export program
    count: int = 1  #: patches, crops or snapshots per call; fixed in ONNX, any number for a torch.export program
    fiducials: int = 8  #: largest number of fiducials of the object, for a query network


@dataclass(frozen=True)
class Describe:
    """List every key of an experiment file: type, default and meaning.

    For example:
        imgcal describe experiments
    """

    what: Annotated[Literal["experiments"], tyro.conf.Positional]  #: the kind of file


@dataclass(frozen=True)
class Harvest:
    """Make training data from a calibrated capture: crops of its frames in which the place of every marker is known.

    All cameras together give the object's pose in a snapshot, so frames in which detection fails are labelled, too.
    Writes OUT/train.safetensors and OUT/held_out.safetensors (other snapshots that are never neighbours of those in
    train; other cameras, if there are fewer than five snapshots), the same for patches of single markers
    (train_patches, held_out_patches), and OUT/README.md, which describes them. Of 5 to 19 snapshots, every fifth is
    held out, and its neighbours are in neither file.

    For example:
        imgcal harvest my_capture --rig out/rig.yaml --object object.csv --out dataset
        imgcal train ir-cnn --from dataset --out adapted
        imgcal train measurer-cnn --from dataset --out measurer
        imgcal calibrate my_capture --rig factory.yaml --object object.csv --detector adapted --measurer measurer
        --out out2
    """

    capture: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="CAPTURE")]
    """capture folder, or a shipped sample (sample:O10)"""
    rig: str  #: the calibrated rig that imgcal calibrate wrote
    object: str  #: object: a file, or the name of a shipped one
    out: Path  #: folder to write
    snapshots: str | None = None  #: A:B, numbers in file order from 0, without B; default: all
    detector: str = "auto"  #: what finds the object where blobs decide nothing: auto, both, or classical (nothing)
    seed: int = 0  #: seed of the random places of crops
    videos_differ: bool = False  #: accept videos whose lengths or time stamps differ; match frames by number
    detection: Annotated[DetectionOptions, tyro.conf.arg(name="")] = field(default_factory=DetectionOptions)


@dataclass(frozen=True)
class Train:
    """Train a network as described by an experiment file.

    Writes OUT/model.safetensors, resolved.yaml, metrics.jsonl and TensorBoard files. The state is saved from time to
    time and at Ctrl-C; --resume continues from there, with the same result. For several processes: torchrun
    --nproc-per-node 2 -m imgcal train ...; on GPUs also accelerate launch -m imgcal train ...

    For example:
        imgcal train table1-row01 --out out/row01
        imgcal train ir-cnn --from dataset --out adapted
    """

    experiment: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="EXPERIMENT")]
    """experiment file, or the name of a shipped experiment"""
    out: Path  #: folder to write
    resume: bool = False  #: continue the training in OUT
    dataset: Annotated[Path | None, tyro.conf.arg(name="from")] = None
    """dataset from imgcal harvest: train the shipped network of that name further for some minutes, on your own frames
    mixed with rendered ones; the best weights on held-out frames are kept"""
    set: Annotated[tuple[tuple[str, ...], ...], tyro.conf.UseAppendAction, tyro.conf.arg(metavar="KEY=VALUE ...")] = ()
    """values of the experiment to change, such as training.steps=100"""
    minutes: float | None = None  #: length of the training; the same as --set training.minutes=...


@dataclass(frozen=True)
class Captures:
    """Simulated captures."""

    captures: int = 0  #: captures per difficulty; if given, detectors are compared on frames
    difficulty: tuple[str, ...] = ()  #: names, as for imgcal simulate --difficulty; default: all
    snapshots: int = 4  #: snapshots per capture


@dataclass(frozen=True)
class Setting:
    """Random rigs."""

    rig: str | None = None  #: factory rig: a file, or the name of a shipped one; default: the first model's
    object: str | None = None  #: object: a file, or the name of a shipped one; default: the first model's
    kappa: float | None = None  #: relative drift of all parameters, 0.025 = 2.5 %; default: the first model's drift
    phi: tuple[float, float] | None = None  #: degrees, range of the angle from the zenith; default: the first model's
    noise: float = 0.0  #: px, standard deviation of each coordinate
    missing: float = 0.0  #: share of fiducials that are not seen
    swapped: float = 0.0  #: share of labels exchanged within a camera
    false: float = 0.0  #: share of fiducials found somewhere else in the image
    level: int | None = None
    """0 to 4: difficulty of points and images (imgcal.synthesis.LEVELS), instead of the four options above"""
    count: int = 20_000  #: rigs per trial
    trials: int = 3  #: each with other rigs
    seed: int = 0  #: the same seed gives the same rigs
    sweep: tuple[Axis, ...] = ()  #: plot the error against these quantities, without the slow baselines
    sweep_count: int = 1000  #: rigs per point of a sweep
    trust: tuple[str, ...] = ()
    """your own encoders (package.module:Class) that models may name; their code is run"""
    device: Literal["auto", "cpu"] = "auto"  #: where networks run; auto = on a GPU if there is one
    address: str | None = None  #: Ray cluster to use; default: this machine
    cores: int | None = None  #: cores of this machine to use; default: all for long jobs, one for short ones


@dataclass(frozen=True)
class Evaluate:
    """Measure networks and classical methods on random rigs, alone and refined.

    Every network is compared with Levenberg-Marquardt steps from the factory rig. RE is the paper's error: per rig the
    root mean square over cameras, fiducials and both axes, averaged over the rigs of a trial; shown are its mean and
    spread over trials. The paper's figure is one pass of a network. Held-out errors are on points that took no part in
    the fit. Slow baselines get only the first few rigs of every trial (last column). With --out: evaluation.json,
    evaluation.md and plots.

    For example:
        imgcal evaluate out/row01 --out result
        imgcal evaluate --rig O10 --object cube8 --kappa 0.025 --count 2000 --noise 0.1 --missing 0.2
    """

    models: Annotated[tuple[Path, ...], tyro.conf.Positional, tyro.conf.arg(metavar="[MODEL ...]")] = ()
    """trained networks: *.safetensors files or folders of training runs; none = baselines only"""
    setting: Annotated[Setting, tyro.conf.arg(name="")] = field(default_factory=Setting)
    baselines: bool = True  #: include the slow classical methods
    out: Path | None = None  #: folder to write; default: nothing is written


@dataclass(frozen=True)
class Compare:
    """Compare networks on the same random rigs, or detectors on the same simulated captures.

    Networks: accuracy alone and refined, time, parameters and size. All must be for the same rig and object; poses and
    drift are those of the first network unless given. Training runs that differ only in the seed share a row: mean and
    spread over seeds. The output of each encoder is also shuffled, zeroed and replaced by noise: if that does no harm,
    the network does not use it. With --out: evaluation.json, evaluation.md and plots. The default of 3 trials of 20,000
    rigs takes many minutes; --count 100 --trials 1 gives a first impression.

    Detectors (--captures): each calibrates the same simulated captures from their frames, at every difficulty. The
    table shows how many it calibrates, refuses, and gets wrong (more than 1 px over the working volume, and more than 5
    times the error it predicts). With --out: captures.json and captures.md.

    For example:
        imgcal compare out/vit out/cnn --out comparison --count 2000
        imgcal compare classical matched --captures 20 --difficulty low-light clutter
    """

    models: Annotated[tuple[Path, ...], tyro.conf.Positional, tyro.conf.arg(metavar="MODEL ...")]
    """two or more trained networks: *.safetensors files or folders of training runs; with --captures, one or more
    detectors, as for imgcal calibrate --detector"""
    out: Path | None = None  #: folder to write; default: nothing is written
    setting: Annotated[Setting, tyro.conf.arg(name="")] = field(default_factory=Setting)
    baselines: bool = False  #: include the slow classical methods
    captured: Annotated[Captures, tyro.conf.arg(name="")] = field(default_factory=Captures)

    def __post_init__(self) -> None:
        """Require models: the parser accepts any number of them."""
        if not self.models:
            raise InputError(
                "compare: found no models, expected two or more (or, with --captures, one or more detectors)"
            )


@dataclass(frozen=True)
class Fleet:
    """Recalibrate every capture of a table, on all cores or a cluster, and learn the fleet's drift from them.

    MANIFEST is a CSV or Parquet file with a column `capture` (folder or table of blobs: a path relative to the
    manifest, or a URL), and optionally `rig`, `object`, `device`, `time`, `hours` since the factory calibration, and
    other columns of numbers such as `temperature`. OUT/results is a Parquet dataset with a row per capture,
    including those that are refused, damaged, hang or crash. A rerun does what is missing or has changed.
    OUT/prior.yaml is the drift prior learned from the fleet, for rig files; OUT/report.html shows it, and the outlier
    cameras.

    For example:
        imgcal fleet captures.csv --rig rig.yaml --object object.csv --out fleet
    """

    manifest: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="MANIFEST")]
    """table of captures: a file or URL"""
    out: Path  #: folder of the results
    rig: str | None = None  #: factory rig of rows without one: a file, or the name of a shipped one
    object: str | None = None  #: object of rows without one: a file, or the name of a shipped one
    address: str | None = None  #: Ray cluster to use; default: this machine
    cores: int | None = None  #: cores of this machine to use; default: all
    detector: str = "classical"  #: what finds the markers in frames, as for imgcal calibrate
    blind_cameras: bool = False  #: accept cameras that see nothing; they keep their factory values
    seconds: float = 300.0  #: time limit per capture
    memory_mb: float = 4096.0  #: memory limit per capture, besides what every process needs
    keep_rigs: bool = False  #: write the recalibrated rig file of every capture to OUT/rigs
    again: bool = False  #: retry captures that timed out, crashed or ran out of memory
    covariates: tuple[str, ...] = ()  #: columns that drift may depend on, such as temperature
    by_camera: bool = False  #: learn a spread for each camera, instead of one for all
    batch: int = 32  #: captures per batch of work


@dataclass(frozen=True)
class Demo:
    """See imgcal at work: a simulated rig that is kept calibrated, on a page where you can bump and cover its cameras.

    Open the address that is printed. Ctrl-C ends the demo.

    For example:
        imgcal demo live
    """

    what: Annotated[Literal["live"], tyro.conf.Positional]  #: the live page
    rig: str = "O10"  #: rig: a file, or the name of a shipped one (O10, O6, U7, T4, room10)
    object: str = "asymmetric8"  #: object: a file, or the name of a shipped one
    serve: str | None = None  #: [HOST:]PORT to listen on; default: 127.0.0.1:8765, for this machine only
    token: str | None = None  #: token that other machines need to open the page; default: a new one
    rate: float = 15.0  #: snapshots per second


@dataclass(frozen=True)
class Warmup:
    """Compile now what the first calibration would wait for: when an image is built, or before a service starts.

    Compiled code goes to the folder named by the environment variable NUMBA_CACHE_DIR, or else to the user's cache
    folder. It serves this version of imgcal and this kind of processor.

    For example, in a Dockerfile whose image is run from a read-only file system:
        ENV NUMBA_CACHE_DIR=/opt/imgcal-cache
        RUN imgcal warmup
    """

    all_lenses: bool = False
    """also compile for rigs with a lens other than brown_conrady (rational, equidistant)"""
