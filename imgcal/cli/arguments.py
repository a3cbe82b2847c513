"""What every command takes: its options, their defaults, and the words of its help.

Nothing here waits for a numerical library, so that help, completion and a slip of the keyboard are answered at once.
The command of the same name takes these values and runs.
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
    """Make a capture: one rig that has drifted from its factory calibration, seen through realistic infrared frames.

    Writes OUT/frames/<camera>/<snapshot>.png, the factory rig and the object beside them, and OUT/truth/ with the
    drifted rig, the exact image points (labelled), the object's poses and how much of each marker is seen (seen.csv).
    --difficulty makes frames that are hard: dim, blurred by motion, out of focus, cluttered, with half-hidden markers.
    Without other options, the rig drifts by half a degree, 2 mm, 1 % and 5 px (one standard deviation: --physical.*).
    Examples: imgcal simulate --rig O10 --object asymmetric8 --out my_capture --snapshots 20
    imgcal simulate --rig room10 --object wand4 --out wand --snapshots 100 --poses hand-held --exposure-ms 2
    """

    rig: str  #: factory rig: file, or the name of a shipped one (O10, O6, U7, T4, room10)
    object: tuple[str, ...]
    """object: file, or the name of a shipped one (asymmetric8, cube8, cube27, sphere64, wand4; printed boards: charuco,
    aprilgrid, checkerboard, circles); several, each of which moves by itself: --object A B; lights = a body with
    unknown markers (--lights)"""
    out: Path  #: folder to write; must not hold a capture yet
    lights: int = 15  #: number of markers on the body, with --object lights
    snapshots: int = 10  #: number of poses of the object
    seed: int = 0  #: the same seed gives the same capture
    drift: Literal["physical", "relative", "none"] | None = None
    """physical = degrees, mm and pixels, the default; relative = the paper's value * (1 + delta), as with --kappa"""
    kappa: float | None = None
    """the paper's drift: the largest relative change of intrinsics, positions and Euler angles, 0.025 with --drift
    relative alone; of cameras that face each other, some Euler angles are large, and such cameras turn far"""
    physical: PhysicalDrift = field(default_factory=PhysicalDrift)  # standard deviations for --drift physical
    poses: Literal["hemisphere", "volume", "hand-held"] | None = None
    """where the object is: hemisphere = always at the rig's working_distance, turned, and in view of every camera (the
    paper's); volume = anywhere in the rig's volume, in view of some; hand-held = on a smooth way through it. Default:
    volume where the rig file has one or has no working_distance, and hemisphere elsewhere"""
    hand: Annotated[HandHeld, tyro.conf.arg(name="")] = field(default_factory=HandHeld)
    exposure_ms: float = 0.0  #: ms, during which the markers of a hand-held object are smeared, as fast as they move
    theta_deg: tuple[float, float] = (0.0, 360.0)  #: azimuth of the rig around the object, on the hemisphere
    phi_deg: tuple[float, float] = (0.0, 90.0)  #: angle of the rig from the object's z axis, on the hemisphere
    alpha_deg: tuple[float, float] = (0.0, 360.0)  #: roll of the rig, on the hemisphere
    marker_radius: float = 6.0  #: mm, for objects whose file gives no radius
    clutter: bool = True  #: reflections, false blobs, partly hidden markers
    difficulty: Level | None = None  #: a named level; its light and clutter replace those of the options below
    sensor: SensorModel = field(default_factory=SensorModel)
    clutter_model: ClutterModel = field(default_factory=ClutterModel)


@dataclass(frozen=True)
class LookAt:
    """Make a rig of equal cameras in a ring, a dome or a row that all look at one point; z is up.

    Example: imgcal rig look-at --shape ring --cameras 8 --radius 4000 --height 2500 --target 0 0 1000 --out ring8.yaml
    """

    out: Path  #: rig file to write
    shape: Shape = "ring"
    """ring = on a circle about the z axis; dome = over a half sphere; row = on a line along x"""
    cameras: int = 8  #: how many
    radius: float = 4000.0  #: mm: of the circle or the sphere; half the length of a row
    height: float = 2500.0  #: mm: z of the circle or the line, or of the sphere's centre
    target: tuple[float, float, float] = (0.0, 0.0, 1000.0)  #: mm: what all look at
    lens: Annotated[Lens, tyro.conf.arg(name="")] = field(default_factory=Lens)
    volume: tuple[float, float, float, float, float, float] | None = None
    """mm: the box in which the rig is used, least x y z and largest x y z; default: about the target"""


@dataclass(frozen=True)
class Cameras:
    """Make a file of cameras whose image size and rough field of view are all that is known.

    It is what imgcal calibrate --cameras begins with where there is no factory calibration.
    Example: imgcal rig cameras my_capture --field-of-view-deg 65 --out cameras.yaml
    """

    capture: Annotated[Path, tyro.conf.Positional]  #: capture folder: its cameras, and the sizes of their images
    field_of_view_deg: float  #: degrees across the longer side of the image, roughly (15 %)
    out: Path  #: file to write


@dataclass(frozen=True)
class Rig:
    """Make rig files: cameras that look at a point, for simulations, or cameras yet to be calibrated.

    imgcal rig look-at --help and imgcal rig cameras --help tell more.
    """

    what: Annotated[
        Annotated[LookAt, tyro.conf.subcommand("look-at", prefix_name=False)]
        | Annotated[Cameras, tyro.conf.subcommand("cameras", prefix_name=False)],
        tyro.conf.arg(name=""),
    ]


@dataclass(frozen=True)
class Detect:
    """Find blobs in captured frames and measure their centres.

    Writes one row a blob: snapshot, camera, u, v, sigma (pixels), radius, flags (1 touches the border, 2 merged,
    4 saturated, 8 masked, 32 no marker, as --measurer says). Example: imgcal detect my_capture --out detections.csv
    """

    capture: Annotated[Path, tyro.conf.Positional]  #: folder with frames/<camera>/<snapshot>.png
    out: Path  #: CSV or CSV.gz to write
    rig: str | None = None  #: rig file or name, to check camera names and image sizes against
    snapshots: str | None = None  #: A:B, numbers in file order from 0, B excluded
    videos_differ: bool = False  #: accept videos whose lengths or time stamps differ: frames go together by number
    measurer: str | None = None  #: network that measures blobs again: a file, the folder of a run, or a shipped name
    detection: Annotated[DetectionOptions, tyro.conf.arg(name="")] = field(default_factory=DetectionOptions)


@dataclass(frozen=True)
class Calibrate:
    """Recalibrate a rig from captured frames (or a table of blobs) of a known object.

    Writes OUT/rig.yaml (the recalibrated rig, with the standard deviation of every parameter), OUT/result.json and
    OUT/report.html; where the object's fiducials were estimated, too, also OUT/object.csv. If the data cannot decide,
    the reason is in result.json and report.html, no rig.yaml is written, the exit code is 3, and an earlier calibration
    in OUT moves to OUT/previous. OUT changes when all is written; any other failure leaves it as it was.
    Examples: imgcal calibrate my_capture --rig factory.yaml --object object.csv --out result
    imgcal calibrate my_capture --cameras cameras.yaml --object wand4 --out result
    imgcal calibrate my_capture --rig factory.yaml --object pointer.csv reference.csv --out result
    """

    input: Annotated[Path, tyro.conf.Positional]  #: capture folder, detections file, or a shipped sample (sample:O10)
    object: tuple[str, ...]
    """object: file, or the name of a shipped one; several, any of which may be in view: INPUT --object A B; lights =
    unknown markers, every blob may be one: the scale then rests on the factory positions of the cameras"""
    out: Path  #: folder to write
    rig: str | None = None  #: factory rig: file, or the name of a shipped one
    cameras: Path | None = None
    """instead of --rig, without a factory calibration: a file with each camera's image size and rough focal length or
    field of view (imgcal rig cameras writes one), or a calibration whose camera places do not count; carry
    the whole object through what neighbouring cameras see together; the rig's frame is that of its first camera"""
    distance: tuple[str, str, float] | None = None
    """with --cameras and a light, or --object lights: CAMERA CAMERA MM, the distance of two cameras, which gives the
    scale; without it the rig is known up to scale. The first is in the origin of the rig's frame, the second on its x
    axis"""
    snapshots: str | None = None  #: A:B, numbers in file order from 0, B excluded
    videos_differ: bool = False  #: accept videos whose lengths or time stamps differ: frames go together by number
    detector: str = "classical"
    """who finds the fiducials in frames: classical (blobs), matched (the whole pattern at once, for frames too dim,
    blurred or cluttered for blobs; slower), auto (blobs, and the pattern where these decide nothing), learned (a
    network for any rig and object), both (blobs, and the network where these decide nothing), or the network's file or
    run"""
    measurer: str | None = None
    """network that measures blobs again, and what learned finds: a file, the folder of a run, or a shipped name"""
    first_guess: str = "none"  #: where to start: none (factory rig), points, vit, cnn (shipped), a file or run
    trust: tuple[str, ...] = ()  #: encoders of yours, package.module:Class, that its file may name: their code runs
    without: tuple[str, ...] = ()  #: cameras to leave out
    blind_cameras: bool = False  #: accept cameras that see nothing; they keep their factory values
    after_last_move: bool = False  #: where a camera moved during the capture, use the snapshots since then
    labelled: Path | None = None
    """file for all blobs with the labels that they got, a table like the input; labels that do not fit have flag 16"""
    start_pose: StartPose | None = None
    """rig_from_object of the first snapshot, roughly: rotation vector (3 numbers, rad) and translation (3, mm); decides
    which way round a symmetric object is"""
    object_tolerance: float = 0.0
    """mm: how far each fiducial may be from its place in the object file (one standard deviation of each coordinate),
    where that has no column `tolerance`; 0 = exact, unless the images say otherwise"""
    object_scale_tolerance: float = 0.0
    """how far all distances of the object may be off together, one standard deviation (0.01 is 1 %); 0 = exact"""
    full_covariance: bool = False  #: write the whole covariance matrix to rig.yaml, too
    report: bool = True  #: write report.html
    reference: str | None = None
    """camera that positions and rotations are relative to, in rig.yaml's uncertainty (default: the first) and in the
    report (default: most cameras are taken to have stood still)"""
    detection: Annotated[DetectionOptions, tyro.conf.arg(name="")] = field(default_factory=DetectionOptions)


@dataclass(frozen=True)
class Watch:
    """Keep a running rig calibrated: learn from every snapshot, and report cameras that move.

    INPUT is what the cameras write or send:
    a folder that is being filled with frames/<camera>/<snapshot>.png, or that holds a video a camera;
    tcp://host:port or ipc://path, frames or blobs from another process through ZeroMQ;
    qtm://host, markers from Qualisys' QTM as it measures or plays;
    lsl://name, blobs through the Lab Streaming Layer;
    - for blobs on standard input, a line of JSON each: {"camera": "cam01", "time": 12.5, "uv": [[u, v], ...]};
    a rosbag2 folder or .mcap file; a table of blobs (.csv, .csv.gz).

    OUT gets rig.yaml (the rig as it is now, replaced in one step), history/ (as it was), events.jsonl (what happened:
    a line of JSON each) and state.json, from which the same command resumes after any end, even a power failure.
    Ends with the input, or at Ctrl-C. Example: imgcal watch tcp://127.0.0.1:5555 --rig factory.yaml --object
    object.csv --out out/watch
    """

    input: Annotated[str, tyro.conf.Positional]  #: folder, address, file or -
    rig: str  #: factory rig: file, or the name of a shipped one
    object: tuple[str, ...]
    """object: file, or the name of a shipped one; lights = whatever bright markers move through the volume. The markers
    of a stick, or of several objects, are followed like these, one by one: RIG should come from calibrate, and its
    scale stays as that says"""
    out: Path  #: folder to write
    fresh: bool = False  #: forget what an earlier run left in OUT, begin from the factory rig
    tolerance: float = Timing.tolerance  #: s that the time stamps of one snapshot may be apart
    patience: float = Timing.patience  #: s that a camera is waited for
    keep_all: bool = False  #: drop no snapshot where they come faster than worked on: for recordings that come live
    rate: float | None = None  #: snapshots a second of a table of blobs (30)
    topic: tuple[str, ...] = ()  #: CAMERA=TOPIC of a recording, where the topic does not name the camera
    videos_differ: bool = False  #: accept videos whose lengths or time stamps differ: frames go together by time
    until_idle: float | None = None  #: end when a folder has got no new frame for so many seconds
    remove: bool = False  #: delete the frames of a folder once what they taught is saved
    metrics: str | None = None  #: [HOST:]PORT for Prometheus; the host is 127.0.0.1 if not given
    serve: str | None = None  #: [HOST:]PORT of the live page; the host is 127.0.0.1 if not given
    poses: tuple[str, ...] = ()
    """where the object's pose of each snapshot goes: FILE.csv, FILE.jsonl, tcp://HOST:PORT (ZeroMQ) or
    igtl://[HOST:]PORT (OpenIGTLink: 3D Slicer, PLUS); its markers, or lights, as 3D points: FILE.c3d, FILE.trc;
    several are possible"""
    hook: str | None = None
    """command to run for each event, without a shell; the event is its standard input, a line of JSON"""
    detector: str = "classical"  #: who finds the fiducials in frames, as for imgcal calibrate
    learn: bool = False
    """with --detector learned: adapt detector and measurer to this rig's own frames while it runs, in a process of the
    lowest priority. OUT/learning/dataset gets crops of snapshots, some of them held out; a training begins after 30
    snapshots and 8 held-out ones. The adapted networks run only once they are better on held-out snapshots, otherwise
    they are dropped; an event says which. They stay in OUT/learning/adapted, for the next start and for imgcal
    calibrate --detector --measurer"""
    detection: Annotated[DetectionOptions, tyro.conf.arg(name="")] = field(default_factory=DetectionOptions)


@dataclass(frozen=True)
class Score:
    """Measure the reprojection error of a rig that is held fixed; only the object's pose is fitted in each snapshot.

    Prints a table on a terminal, and JSON into a file or pipe: median_px, p95_px, rms_px, outliers,
    rms_px_with_outliers, points, snapshots_used, snapshots_rejected, per_camera. All errors are lengths in pixels; the
    RMS is that of OpenCV's calibrateCamera, sqrt(2) times the paper's RE. Outliers are points much farther off than
    most in their camera, such as half-hidden markers; median_px and p95_px include them.
    Example: imgcal score my_capture --rig out/rig.yaml --object object.csv
    """

    input: Annotated[Path, tyro.conf.Positional]  #: capture folder, detections file, or a shipped sample (sample:O10)
    rig: str  #: rig file, or the name of a shipped rig
    object: tuple[str, ...]
    """object file, or the name of a shipped object; several, any of which may be in view: INPUT --object A B; lights =
    every blob may be a marker of its own"""
    json: bool = False  #: print JSON on a terminal, too
    snapshots: str | None = None  #: A:B, numbers in file order from 0, B excluded
    videos_differ: bool = False  #: accept videos whose lengths or time stamps differ: frames go together by number
    detection: Annotated[DetectionOptions, tyro.conf.arg(name="")] = field(default_factory=DetectionOptions)


@dataclass(frozen=True)
class Render:
    """Redraw captured frames as colour-coded images: every fiducial a soft dot in its own colour, nothing else.

    Blobs are found and identified first; what has no certain identity is not drawn. Writes OUT/<camera>/<snapshot>.png.
    Example: imgcal render my_capture --rig O10 --object asymmetric8 --out coded --size 224
    """

    input: Annotated[Path, tyro.conf.Positional]  #: capture folder, detections file, or a shipped sample (sample:O10)
    rig: str  #: rig file, or the name of a shipped rig
    object: str  #: object file, or the name of a shipped object
    out: Path  #: folder to write
    size: int = 224  #: width and height of the images, pixels
    dot: float = 1.5  #: standard deviation of a dot, pixels of the output
    snapshots: str | None = None  #: A:B, numbers in file order from 0, B excluded
    videos_differ: bool = False  #: accept videos whose lengths or time stamps differ: frames go together by number
    detection: Annotated[DetectionOptions, tyro.conf.arg(name="")] = field(default_factory=DetectionOptions)


@dataclass(frozen=True)
class Convert:
    """Convert the calibration of a rig: another tool's to ours, ours to another tool's, or one tool's to another's.

    What SOURCE is, its content says. What is written is read back and compared on known points in every camera; nothing
    is guessed, and what had to be assumed is printed. docs/formats.md has the formats.
    Example: imgcal convert camchain.yaml --out rig.yaml
    """

    source: Annotated[tuple[Path, ...], tyro.conf.Positional]
    """a file, a folder, or the files that are one calibration together; a rig file of ours, or a shipped rig"""
    out: Path
    """file to write; a folder where the format has several files"""
    source_format: Annotated[str | None, tyro.conf.arg(name="from")] = None
    """format of SOURCE by name, where its content is not to decide"""
    to: str | None = None
    """format to write by name (default: imgcal, where --out ends in .yaml); with --into, the format of that"""
    into: tuple[Path, ...] = ()
    """another tool's file, folder or files with the same cameras: OUT is a copy with their numbers replaced"""
    source_rig: str | None = None
    """name of the rig, where SOURCE, or what --into names, holds several (COLMAP)"""
    unit: str | None = None
    """unit of SOURCE, where its format does not say: mm, cm, m, inch, or the length of one unit, such as 417.2mm"""
    distance: tuple[str, str, float] | None = None
    """two cameras, and how many mm they are apart, where the unit is not known"""
    image_size: tuple[str, ...] = ()
    """WIDTHxHEIGHT of all cameras, or NAME=WIDTHxHEIGHT of one, where SOURCE does not say"""
    cameras: tuple[str, ...] = ()
    """names of the cameras to keep, in the order to write them (default: all)"""
    out_unit: str | None = None
    """unit to write, where the format leaves that to its user; with --into, of the lengths in that"""
    hold_distortion: bool = False
    """write a rig file whose calibrations keep the distortion of the lenses, so that they can go back into SOURCE"""
    fit_limit: float = LIMIT
    """px that a lens may be off, anywhere in its image, where another model takes its place by a fit"""


@dataclass(frozen=True)
class Export:
    """Write a trained network for another runtime: ONNX, or a program of torch.export.

    MODEL is a point network, a query network for infrared frames, or a measurer. What is written is run, ONNX by
    onnxruntime, and compared with PyTorch. docs/runtimes.md has inputs and outputs.
    Example: imgcal export measurer-cnn --to onnx --out measurer.onnx
    """

    model: Annotated[str, tyro.conf.Positional]  #: file, folder of a training run, or the name of a shipped network
    out: Path  #: file to write
    to: Literal["onnx", "pt2"] = "onnx"  #: ONNX, or a program of torch.export
    count: int = 1  #: patches, crops or snapshots at a time; fixed in ONNX, a program of torch.export takes any number
    fiducials: int = 8  #: of the object, for a query network: it serves objects with as many or fewer


@dataclass(frozen=True)
class Describe:
    """List every key of an experiment file: type, default and meaning.

    Example: imgcal describe experiments
    """

    what: Annotated[Literal["experiments"], tyro.conf.Positional]  #: the kind of file


@dataclass(frozen=True)
class Harvest:
    """Make training data of a calibrated capture: crops of its frames in which every marker's place is known.

    The object's pose in a snapshot comes from all cameras, so that frames in which detection fails are labelled, too.
    Writes OUT/train.safetensors, OUT/held_out.safetensors (other snapshots, never their neighbours; of fewer than five
    snapshots, other cameras), the same for patches of single markers (train_patches, held_out_patches), and
    OUT/README.md, which says what is in them.
    Example: imgcal harvest my_capture --rig out/rig.yaml --object object.csv --out dataset
    then: imgcal train ir-cnn --from dataset --out adapted
    and: imgcal train measurer-cnn --from dataset --out measurer
    and: imgcal calibrate my_capture --rig factory.yaml --object object.csv --detector adapted --measurer measurer
    --out out2
    """

    capture: Annotated[Path, tyro.conf.Positional]  #: capture folder, or a shipped sample (sample:O10)
    rig: str  #: the calibrated rig: what `imgcal calibrate` wrote
    object: str  #: object file, or the name of a shipped object
    out: Path  #: folder to write
    snapshots: str | None = None  #: A:B, numbers in file order from 0, B excluded
    detector: str = "auto"  #: what finds the object where blobs decide nothing: auto, both, or classical for none
    size: int = 96  #: crop pixels, each way: as the network takes them
    seed: int = 0  #: of the crops' places
    videos_differ: bool = False  #: accept videos whose lengths or time stamps differ: frames go together by number
    detection: Annotated[DetectionOptions, tyro.conf.arg(name="")] = field(default_factory=DetectionOptions)


@dataclass(frozen=True)
class Train:
    """Train a network as an experiment file says.

    Writes OUT/model.safetensors, resolved.yaml, metrics.jsonl and TensorBoard's files.
    Ctrl-C saves the state first, as the training does from time to time; --resume continues from there, with the same
    result.
    Several processes: torchrun --nproc-per-node 2 -m imgcal train ...; on GPUs also accelerate launch -m imgcal ...
    Example: imgcal train table1-row01 --out out/row01
    """

    experiment: Annotated[str, tyro.conf.Positional]  #: experiment file, or the name of a shipped experiment
    out: Path  #: folder to write
    resume: bool = False  #: go on with the training in OUT
    dataset: Annotated[Path | None, tyro.conf.arg(name="from")] = None
    """dataset of `imgcal harvest`: the shipped network of the experiment's name is trained further on your own frames,
    mixed with rendered ones, for some minutes; what it says of held-out frames decides which weights are kept"""
    set: Annotated[tuple[tuple[str, ...], ...], tyro.conf.UseAppendAction, tyro.conf.arg(metavar="KEY=VALUE ...")] = ()
    """values of the experiment to change, such as training.steps=100"""
    minutes: float | None = None  #: train so long; the same as --set training.minutes=...


@dataclass(frozen=True)
class Captures:
    """What captures are simulated."""

    captures: int = 0  #: so many a difficulty: compare detectors on captured frames instead of networks on points
    difficulty: tuple[str, ...] = ()  #: names as of `imgcal simulate --difficulty`; default: all
    snapshots: int = 4  #: of a capture


@dataclass(frozen=True)
class Setting:
    """What the random rigs are."""

    rig: str | None = None  #: factory rig: file, or the name of a shipped one; default: the first model's
    object: str | None = None  #: object: file, or the name of a shipped one; default: the first model's
    kappa: float | None = None  #: perturbation of all parameters, 0.025 = 2.5 %; default: the first model's drift
    phi: tuple[float, float] | None = None  #: angles from the zenith in degrees; default: the first model's
    noise: float = 0.0  #: px, standard deviation of each axis
    missing: float = 0.0  #: share of fiducials that are not seen
    swapped: float = 0.0  #: share of labels exchanged within a camera
    false: float = 0.0  #: share of fiducials found somewhere else in the image
    level: int | None = None
    """instead of these, points and images as hard as a level of `imgcal.synthesis.LEVELS`: 0 to 4"""
    count: int = 20_000  #: rigs a trial
    trials: int = 3  #: each with other rigs
    seed: int = 0  #: same seed, same rigs
    sweep: tuple[Axis, ...] = ()  #: draw the error against these, without the slow baselines
    sweep_count: int = 1000  #: rigs at every point of a sweep
    trust: tuple[str, ...] = ()  #: encoders of yours, package.module:Class, that models may name: their code runs
    device: Literal["auto", "cpu"] = "auto"  #: where networks run; "auto" = on a GPU if there is one
    address: str | None = None  #: running Ray cluster that does the work, on its cores; none = this machine
    cores: int | None = None  #: of this machine; 1 = this process alone; none = all, if that is worth a start of Ray


@dataclass(frozen=True)
class Evaluate:
    """Measure networks and classical methods on random rigs, alone and refined.

    RE is the paper's error: per rig the root mean square over cameras, fiducials and both axes, averaged over the rigs
    of a trial; mean and spread over trials. What the paper reports is one pass of a network. Held-out: the same on
    points that took no part. Levenberg-Marquardt steps from the factory rig stand beside every network; slow baselines
    get the first few rigs of every trial (last column). With
    --out: evaluation.json, evaluation.md and plots. Examples:
    imgcal evaluate out/row01 --out result
    imgcal evaluate --rig O10 --object cube8 --kappa 0.025 --count 2000 --noise 0.1 --missing 0.2 --swapped 0.1
    """

    models: Annotated[tuple[Path, ...], tyro.conf.Positional] = ()
    """trained networks: *.safetensors, or folders of training runs; none = baselines alone"""
    setting: Annotated[Setting, tyro.conf.arg(name="")] = field(default_factory=Setting)
    baselines: bool = True  #: the slow classical methods in the same table, too
    out: Path | None = None  #: folder to write; default: nothing is written


@dataclass(frozen=True)
class Compare:
    """Compare networks side by side on the same random rigs: accuracy alone and refined, time, parameters, size.

    All must be for the same rig and object; poses and drift are those of the first unless said otherwise. Training runs
    of one experiment with different seeds share a line: mean and spread over the seeds. What an encoder says is
    shuffled, zeroed and replaced by noise: where that does not hurt, the network does not use it. With
    --out: evaluation.json, evaluation.md and plots (latency against accuracy, training curves).
    Example: imgcal compare out/vit out/cnn --out comparison --count 2000

    With --captures, detectors instead: each calibrates the same simulated captures from their frames, at every
    difficulty; the table says how many it calibrates, refuses, and gets wrong (more than 1 px over the working volume,
    and more than 5 times what it claims). Writes captures.json and captures.md.
    Example: imgcal compare classical matched --captures 20 --difficulty low-light clutter
    """

    models: Annotated[tuple[Path, ...], tyro.conf.Positional]
    """two trained networks or more: *.safetensors, or folders of training runs; with --captures one detector or more:
    what `imgcal calibrate --detector` takes"""
    out: Path | None = None  #: folder to write; default: nothing is written
    setting: Annotated[Setting, tyro.conf.arg(name="")] = field(default_factory=Setting)
    baselines: bool = False  #: the slow classical methods in the same table, too
    captured: Annotated[Captures, tyro.conf.arg(name="")] = field(default_factory=Captures)

    def __post_init__(self) -> None:
        """Ask for models at once: their number is free, so that the parser does not."""
        if not self.models:
            raise InputError("found no models, expected two or more, or with --captures one detector or more")


@dataclass(frozen=True)
class Fleet:
    """Recalibrate every capture of a table, on all cores of this machine or on a cluster, and learn from all of them.

    MANIFEST is a CSV or Parquet file with a column `capture` (folder or table of blobs; a path beside the manifest, or
    a URL) and, where they are known, `rig`, `object`, `device`, `time`, `hours` since the factory calibration, and
    further columns of numbers such as `temperature`. OUT/results is a Parquet dataset with a row a capture, also for
    those that were refused, are damaged, hang or crash; a rerun does what is missing or has changed. OUT/prior.yaml is
    the drift prior that the fleet teaches, for rig files; OUT/report.html shows it, and the cameras that do not belong.
    Example: imgcal fleet captures.csv --rig rig.yaml --object object.csv --out fleet
    """

    manifest: Annotated[str, tyro.conf.Positional]  #: table of captures: a file or URL
    out: Path  #: folder of the results
    rig: str | None = None  #: factory rig of rows that name none: file, or the name of a shipped one
    object: str | None = None  #: object of rows that name none: file, or the name of a shipped one
    address: str | None = None  #: running Ray cluster to join; none = this machine's cores
    cores: int | None = None  #: of this machine; none = all
    detector: str = "classical"  #: who finds the fiducials in frames, as for `imgcal calibrate`
    blind_cameras: bool = False  #: accept cameras that see nothing; they keep their factory values
    seconds: float = 300.0  #: that a capture may take
    memory_mb: float = 4096.0  #: that a capture may take, beyond what a process needs anyway
    keep_rigs: bool = False  #: write the recalibrated rig file of every capture to OUT/rigs, too
    again: bool = False  #: try once more what timed out, crashed or ran out of memory
    covariates: tuple[str, ...] = ()  #: columns that drift may depend on, temperature for example
    by_camera: bool = False  #: learn a spread for each camera, not one for all
    batch: int = 32  #: captures that travel together


@dataclass(frozen=True)
class Demo:
    """See it at work: a simulated rig that is kept calibrated, on a page with buttons that bump and cover its cameras.

    Open the address that is printed. Ctrl+C ends it.
    Example: imgcal demo live
    """

    what: Annotated[Literal["live"], tyro.conf.Positional]  #: the live page
    rig: str = "O10"  #: rig: file, or the name of a shipped one (O10, O6, U7, T4, room10)
    object: str = "asymmetric8"  #: object: file, or the name of a shipped one
    serve: str | None = None  #: HOST:PORT to listen on; 127.0.0.1:8765, for this machine alone, where it is not given
    token: str | None = None  #: that others need who look on from elsewhere; a new one where it is not given
    rate: float = 15.0  #: snapshots a second


@dataclass(frozen=True)
class Warmup:
    """Compile ahead of time what the first calibration would wait for: when an image is built, before a service starts.

    What is compiled is kept in the folder that the environment variable NUMBA_CACHE_DIR names, or else in the user's
    cache folder, for this version and this kind of processor. Example for an image that others will run, from a file
    system that cannot be written: ENV NUMBA_CACHE_DIR=/opt/imgcal-cache, then RUN imgcal warmup
    """

    all_lenses: bool = False
    """compile also for rigs that have a camera with another lens than brown_conrady (rational, equidistant)"""
