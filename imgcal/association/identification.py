"""Match blobs to fiducials: by prediction if a pose is known, otherwise by votes of the whole rig."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from imgcal.association.ambiguities import (
    Ambiguity,
    common_blobs,
    differ,
    displacement,
    lattice_shifts,
    near_symmetries,
    partial_turns,
    relabel,
)
from imgcal.association.assignment import spacing
from imgcal.association.blobs import gather
from imgcal.association.hypotheses import (
    Poses,
    has_many_triples,
    likely_blobs,
)
from imgcal.association.identity import TOO_FEW_BLOBS, Identity, IdentityOptions, Status
from imgcal.association.minimal_labels import compare_labellings, has_minimal_blobs
from imgcal.association.search import DECISIVE, VERIFIED, Search, match_on_lattice
from imgcal.association.stick_poses import fit_sticks
from imgcal.association.verification import (
    STAGES,
    Fits,
    Known,
    Scene,
    drop_uncertain_labels,
    evidence,
    fit_and_label,
    is_settled,
    join,
    most_evidence,
    part_of_camera,
    predictions,
    refine,
    residual_sigma,
    rig_and_pose,
    select_pose,
    settle_labels,
    start,
)
from imgcal.association.voting import predict_ideal, vote
from imgcal.geometry import RigidTransform
from imgcal.medians import median
from imgcal.types import CalibrationObject, CameraRig, Detections

FIRST_HYPOTHESES = 8_000  # in the first round: large objects get fewer triples of blobs; then twice as many each time
MOST_HYPOTHESES = 400_000  # per round
MOST_FALSE = 40  # blobs per fiducial; with more, random triples are hardly ever three fiducials
MOST_PAIRS = 30_000_000  # of fiducials and blobs: limit of memory
PATIENCE = 3  # number of rounds with two good labellings before giving up
MOST_STEPS = 6  # number of moves to a better labelling of the shifted or turned object
APPROXIMATE = 0.02  # rad, error of poses from three points, even for a perfect camera
EXCLUDED = 60.0  # margin that makes a closer comparison unnecessary
LEAST_ALONE = 6  # minimum number of labels for a fit of one camera alone
STICK_SHARE = 0.5  # factor on the required share: a marker with a hidden neighbour has no label at first
MOST_SHARED = 0.2  # maximum share of common blobs for two labellings to be two objects in view
# Explained share near a known pose below which other poses are tried, too: an object shifted by its own edge still
# explains half.
CONVINCING = 0.6
# Residuals (px) of a labelling that is no more than a coarse fit. An object turned almost onto itself explains half of
# the blobs that well, with a rig that is bent to them.
COARSE = 0.9


def identify(
    detections: Detections,
    rig: CameraRig,
    obj: CalibrationObject,
    std: Tensor,
    candidates: Sequence[RigidTransform] = (),
    options: IdentityOptions = IdentityOptions(),
    guesses: Sequence[RigidTransform] = (),
    *,
    search: bool = True,
) -> Identity:
    """Label the blobs of one snapshot: try the candidate poses, then the guesses, then search for others.

    Args:
        detections: blobs of one snapshot; only usable ones count.
        rig: factory rig without batch axes, float64.
        obj: the calibration object.
        std: (C, K) prior standard deviation of each camera's parameters relative to the factory values.
        candidates: rig_from_object that may hold, most probable first: the last snapshot's, or one known from the
            set-up.
        options: how certain the result must be.
        guesses: rig_from_object that are mere guesses worth a try: a labelling found there must beat all rotations of
            the object, as one found without them.
        search: search for others; without, at least one candidate or guess is needed.

    Returns:
        The decision; `Identity.accepted` tells whether the labels may be used.

    Raises:
        InputError: blobs of several snapshots, or cameras that are not the rig's.
    """
    return identify_with(Known(obj, rig, std), detections, candidates, options, guesses, search=search)


def identify_with(
    known: Known,
    detections: Detections,
    candidates: Sequence[RigidTransform] = (),
    options: IdentityOptions = IdentityOptions(),
    guesses: Sequence[RigidTransform] = (),
    *,
    search: bool = True,
) -> Identity:
    """Do the work of `identify`; what snapshots have in common is computed once for all calls with `known`."""
    scene, partial = Scene(gather(detections, known.rig), known), None
    for pose, is_known in [*((pose, True) for pose in candidates), *((pose, False) for pose in guesses)]:
        found = _track(scene, pose, options, is_known)
        if found.accepted and found.explained >= CONVINCING:
            return found
        partial = found if partial is None and found.accepted else partial
    if not search:
        return partial or found
    anew = _relocalize(scene, options)
    return partial if partial is not None and anew.explained <= partial.explained else anew


def track(
    detections: Detections,
    rig: CameraRig,
    obj: CalibrationObject,
    std: Tensor,
    rig_from_object: RigidTransform,
    options: IdentityOptions = IdentityOptions(),
    *,
    pose_known: bool = True,
) -> Identity:
    """Label the blobs of one snapshot near one pose.

    Args:
        detections: as for `identify`.
        rig: as for `identify`.
        obj: as for `identify`.
        std: (C, K) as for `identify`.
        rig_from_object: () the pose, mm.
        options: as for `identify`.
        pose_known: False = the pose is a mere guess: the labelling must beat all rotations of the object.

    Raises:
        InputError: see `identify`.
    """
    return _track(Scene(gather(detections, rig), Known(obj, rig, std)), rig_from_object, options, pose_known)


def _track(scene: Scene, rig_from_object: RigidTransform, options: IdentityOptions, pose_known: bool) -> Identity:
    rig, obj = scene.rig, scene.obj
    if obj.pose_rank < 6:  # its last pose says little: without a pattern it easily fits something else
        return _relocalize(scene, options)
    if scene.blobs.uv[..., 0].size * obj.num_fiducials > MOST_PAIRS:
        return _refuse(scene, _explain_too_many_blobs(scene))
    poses = _one_snapshot(rig_from_object)
    predicted = predict_ideal(rig, scene.known.points, poses)
    distance = _usual_distance(scene.known, poses)
    tolerance, gate = _bounds(scene, distance, pose_known=True)
    # If the fiducials are dense, a wide tolerance pairs them with anything: also try a narrow one.
    gap = spacing(predicted[0])
    tolerances = [tolerance, max(3.0, 0.2 * gap)] if tolerance > 0.4 * gap else [tolerance]
    attempts = [
        match_on_lattice(scene, predicted, vote(scene.blobs, predicted, reach, gate).shift, 1.25 * reach)
        for reach in tolerances
    ]
    fits = start(scene, poses.select(np.zeros(len(attempts), dtype=int)), np.concatenate(attempts))
    before, fits = fits.labels, fit_and_label(scene, fits, STAGES[0])
    share = max(_share(scene, fits.select(np.array([k])), options) for k in range(len(attempts)))
    if share < options.least_share:  # the object is elsewhere: further fits would not find it
        return _refuse(scene, _explain_too_few_labels(obj.name, share, share, options.least_share))
    stages = () if is_settled(before, fits) else STAGES[1:]
    if len(attempts) > 1 and np.array_equal(*fits.labels):
        fits = fits.select(np.array([0]))
    return _decide(scene, refine(scene, fits, stages), options, pose_known)


def relocalize(
    detections: Detections,
    rig: CameraRig,
    obj: CalibrationObject,
    std: Tensor,
    options: IdentityOptions = IdentityOptions(),
) -> Identity:
    """Label the blobs of one snapshot without a known pose; arguments and errors as for `identify`, std (C, K)."""
    return _relocalize(Scene(gather(detections, rig), Known(obj, rig, std)), options)


def _relocalize(scene: Scene, options: IdentityOptions) -> Identity:
    obj = scene.obj
    if obj.pose_rank == 3:
        return _refuse(scene, "a single marker has no pattern: beside labelled snapshots, unlabelled ones are not used")
    if obj.pose_rank == 5:
        sticks = fit_sticks(scene, options.seed)
        if sticks is None:
            return _refuse(scene, "cameras agree on no markers with the distances of the object")
        return replace(_decide(scene, sticks, options, known_pose=False), hypotheses=1)
    cameras = np.flatnonzero(scene.blobs.count >= 4)
    if len(cameras) == 0:
        return _refuse(
            scene, f"{TOO_FEW_BLOBS}: at most {scene.blobs.count.max()} in a camera, expected at least 4 in one"
        )
    compared = compare_labellings(scene, options) if has_minimal_blobs(scene) else None
    if compared is not None and compared.accepted:
        return compared
    most, outer = MOST_FALSE * obj.num_fiducials, has_many_triples(obj)
    hopeful = [
        camera
        for camera in cameras.tolist()
        if scene.blobs.count[camera] <= most or len(likely_blobs(scene.blobs, camera, outer)) <= most
    ]
    if not hopeful or scene.blobs.uv[..., 0].size * obj.num_fiducials > MOST_PAIRS:
        return _refuse(scene, _explain_too_many_blobs(scene))
    bounds = _bounds(scene, scene.rig.working_distance or _guess_distance(scene), pose_known=False)
    generator = np.random.default_rng(options.seed)
    search = Search(scene, hopeful, bounds, alone=not options.others_in_view)
    fits: Fits | None = None
    result = _refuse(scene, "no pose of the object explains the blobs")
    undecided = 0
    for number in range(options.rounds):
        fresh = search.run_round(min(FIRST_HYPOTHESES << number, MOST_HYPOTHESES), generator)
        if fresh is not None:
            fits = fresh if fits is None else _best(scene, join((fits, fresh)), 2 * VERIFIED)
            result = _decide(scene, fits, options, known_pose=False)
            # If two labellings explain enough, more hypotheses will not separate them.
            undecided += result.undecided
        enough = undecided == PATIENCE or search.exhausted or search.hypotheses > options.most_hypotheses
        if result.accepted or enough:
            break
    if compared is not None and not result.accepted:
        result = compared
    return replace(result, hypotheses=search.hypotheses)


def _best(scene: Scene, fits: Fits, count: int) -> Fits:
    """Keep the `count` labellings with the most evidence."""
    if len(fits.labels) <= count:
        return fits
    return fits.select(np.argsort(-evidence(scene, fits), kind="stable")[:count])


def _decide(scene: Scene, fits: Fits, options: IdentityOptions, known_pose: bool) -> Identity:
    """Accept the best labelling, or say why not."""
    odds, least_share = (options.label_odds, options.least_label_odds), options.least_share
    if scene.obj.pose_rank < 6:
        least_share *= STICK_SHARE
    best = settle_labels(scene, _best(scene, fits, 1))
    chosen = drop_uncertain_labels(scene, best, *odds)
    share, refusal, margin, rival = _share(scene, chosen, options), None, -np.inf, None
    if share >= least_share:
        settled, margin = _against_motions(scene, best, known_pose)
        mine = fits
        if options.others_in_view:
            beside = _uses_other_blobs(settled, fits)
            mine = fits.select(np.flatnonzero(~beside))
            if beside.any():
                rival = _runner_up(scene, settled, fits.select(np.flatnonzero(beside)), options.least_margin)
        margin = min(margin, _margin(scene, settled, mine))
        if settled is not best:
            chosen = drop_uncertain_labels(scene, settled, *odds)
            share = _share(scene, chosen, options)
        if margin < options.least_margin:
            refusal = (
                f"another labelling explains the blobs nearly as well, or chance does: margin {margin:.1f}, expected "
                f"{options.least_margin:.0f}; show more of the object, to more cameras"
            )
        elif share < DECISIVE and (residual := float(residual_sigma(scene, settled)[0])) > COARSE:
            refusal = (
                f"the best fit explains only {100 * share:.0f} % of the visible markers, and these to no better than "
                f"{residual:.1f} px: the object may have another pose; show more of it, to more cameras"
            )
    if share < least_share:
        refusal = _explain_too_few_labels(scene.obj.name, _share(scene, best, options), share, least_share)
    elif options.others_in_view and refusal is None and scene.rig.num_cameras > 1 and _cameras(chosen) < 2:
        refusal = "only one camera sees it, and other objects may be in view"
    rig, pose = rig_and_pose(scene, chosen, 0)
    if refusal is not None:
        undecided = share >= least_share
        undecided_at = replace(_refuse(scene, refusal), rig_from_object=pose, rig=rig, margin=margin)
        return replace(undecided_at, undecided=undecided)
    order = 1 if known_pose else len(scene.obj.symmetries)
    status: Status = "by_tracking" if known_pose else "ambiguous" if order > 1 else "unique"
    reason = f"explains {100 * share:.0f} % of the visible markers, margin {margin:.0f}"
    labels, strength = scene.blobs.to_rows(chosen.labels[0]), float(evidence(scene, chosen)[0])
    return Identity(labels, pose, rig, status, order, margin, reason, share, evidence=strength, rival=rival)


def _explain_too_few_labels(name: str, fitted: float, certain_share: float, least: float) -> str:
    """Say why too few labels are certain: nothing fits, or the fit is ambiguous."""
    if fitted >= least:
        return (
            f"the best fit explains {100 * fitted:.0f} % of the visible markers, but only {100 * certain_share:.0f} % "
            f"can be labelled with certainty ({100 * least:.0f} % needed): too few blobs, or too many that are not "
            "fiducials; show more of the object, to more cameras"
        )
    return (
        f"this does not look like {name}: the best fit explains {100 * fitted:.0f} % of the visible markers "
        f"({100 * least:.0f} % needed); check that object and rig are those in the images, and that the blobs are its "
        "fiducials (polarity, threshold, radius)"
    )


def _share(scene: Scene, fits: Fits, options: IdentityOptions) -> float:
    """Labelled share of the visible fiducials: in each camera, at most the smaller number of blobs and fiducials.

    For sticks, and if other objects may be in view, only fiducials that the fit puts into the image count as visible.
    """
    fiducials: NDArray[np.int64] | int = scene.obj.num_fiducials
    if options.others_in_view or scene.obj.pose_rank < 6:
        uv, size = predictions(fits), scene.rig.image_size.numpy()[:, None]
        fiducials = ((uv > 0) & (uv < size)).all(-1).sum(1)
    return float((fits.labels >= 0).sum() / max(np.minimum(scene.blobs.count, fiducials).sum(), 1))


def _cameras(fits: Fits) -> int:
    """Number of cameras in which a labelling has labels."""
    return int((fits.labels[0] >= 0).any(1).sum())


def _uses_other_blobs(best: Fits, others: Fits) -> NDArray[np.bool_]:
    """Tell which labellings (K,) use other blobs than the best one: they may be another object."""
    shared = np.array([common_blobs(best.labels[0], labels).sum() for labels in others.labels])
    return shared <= MOST_SHARED * np.maximum((others.labels >= 0).sum((1, 2)), 1)


def _runner_up(scene: Scene, best: Fits, others: Fits, least: float) -> NDArray[np.int64] | None:
    """Labels (M,) of the best of other labellings; None if it is worse by `least` log odds."""
    strength = evidence(scene, others)
    row = int(strength.argmax())
    if strength[row] <= max(0.0, float(evidence(scene, best)[0]) - least):
        return None
    return scene.blobs.to_rows(others.labels[row])


def _margin(scene: Scene, best: Fits, others: Fits) -> float:
    """Log odds of a labelling against the best different one, and against all blobs being clutter."""
    different = [differ(scene.obj, best.labels[0], labels) for labels in others.labels]
    rivals = evidence(scene, others.select(np.flatnonzero(different))) if any(different) else ()
    return float(evidence(scene, best)[0] - max([0.0, *rivals]))


def _least_margins(scene: Scene, best: Fits, labels: NDArray[np.int64]) -> NDArray[np.float64]:
    """Estimate the least log odds (K,) of a labelling against others (K, C, N) in its place, without fitting these."""
    return np.asarray(evidence(scene, best)[0] - most_evidence(scene, best, labels))


def _against_motions(scene: Scene, best: Fits, known_pose: bool) -> tuple[Fits, float]:
    """Compare a labelling with those of an object shifted or turned onto itself, and change to a better one.

    A lattice may be shifted in all cameras together, or in a single one as far as its prior allows.

    Returns:
        The best labelling found, and its margin over the best of its neighbours.
    """
    shifts = lattice_shifts(scene.obj)
    pose = select_pose(scene, best, 0)
    distance = scene.rig.working_distance or _usual_distance(scene.known, _one_snapshot(pose))
    pattern = scene.known.spread.at(distance)
    turns = [] if known_pose else near_symmetries(scene.obj, 2 * pattern.shape * scene.obj.size)
    turns += [] if known_pose else partial_turns(scene.obj)
    if not shifts and not turns:
        return best, np.inf
    compared: dict[tuple[int, bytes], list[tuple[float, NDArray[np.int64]]]] = {}
    for _ in range(MOST_STEPS):
        pose = select_pose(scene, best, 0)
        labels = best.labels[0]
        alone = _compare_with_shifts(scene, best, shifts, 6 * pattern.shift, compared)
        together = _prefer_shifts(labels, alone)
        if together is not None:
            fit = refine(scene, start(scene, _one_snapshot(pose), together[None]), stages=STAGES[:1])
            if _margin(scene, best, fit) < 0:
                best = settle_labels(scene, fit)
                continue
        where, changed = relabel(pose, labels, shifts + turns)
        rivals = [(where.select(np.array([k])), changed[[k]]) for k in range(len(changed))]
        least = _least_margins(scene, best, changed).tolist()
        excluded = [margin for margin in (*least, *(margin for margin, _, _ in alone)) if margin >= EXCLUDED]
        rivals = [rival for margin, rival in zip(least, rivals, strict=True) if margin < EXCLUDED]
        rivals += [(_one_snapshot(pose), rival[None]) for margin, _, rival in alone if margin < EXCLUDED]
        fits = [refine(scene, start(scene, *rival), stages=STAGES[:1]) for rival in rivals]
        margins = [_margin(scene, best, rival) for rival in fits]
        if not margins or min(margins) >= 0:
            return best, min([np.inf, *margins, *excluded])
        best = settle_labels(scene, fits[int(np.argmin(margins))])
    return best, 0.0


def _compare_with_shifts(
    scene: Scene,
    best: Fits,
    shifts: list[Ambiguity],
    reach: NDArray[np.float64],
    compared: dict[tuple[int, bytes], list[tuple[float, NDArray[np.int64]]]],
) -> list[tuple[float, int, NDArray[np.int64]]]:
    """Compare a labelling with those in which a single camera sees the object shifted, by that camera's own fit.

    Its part in the fit of the whole rig suffices where that excludes the shifts. A single camera with a free pose only
    shows which labelling explains more of its blobs. A shift that it rejects is also rejected by the rig, where the
    camera's prior must bear the shift as well.

    Args:
        scene: the snapshot.
        best: a labelling, fitted.
        shifts: steps of a lattice.
        reach: (C,) pixels; larger shifts are beyond the prior.
        compared: earlier comparisons by camera and its labels (N,): margins and shifted labels; new ones are added.

    Returns:
        Margin of the labelling over the shifted one in that camera, camera, labels (C, N) of all cameras; 0 =
        undecided.
    """
    labels, found = best.labels[0], []
    within = [displacement(predictions(best), motion) < reach for motion in shifts]
    for camera in range(scene.rig.num_cameras):
        key = camera, labels[camera].tobytes()
        if key not in compared:
            near = [motion for motion, reached in zip(shifts, within, strict=True) if reached[camera]]
            compared[key] = _margins_over_shifts(scene, best, camera, near)
        for margin, shifted in compared[key]:
            alone = labels.copy()
            alone[camera] = shifted
            found.append((margin, camera, alone))
    return found


def _margins_over_shifts(
    scene: Scene, best: Fits, camera: int, shifts: list[Ambiguity]
) -> list[tuple[float, NDArray[np.int64]]]:
    """Margins of a labelling over the shifted ones in one camera, and the shifted labels (N,); 0 = undecided."""
    pose, labels, part = select_pose(scene, best, 0), best.labels[0, [camera]], scene.select_camera(camera)
    if not shifts:
        return []
    where, shifted = relabel(pose, labels, shifts)
    margins = np.zeros(len(shifts))
    if (labels >= 0).sum() >= LEAST_ALONE:
        margins = _least_margins(part, part_of_camera(scene, best, camera), shifted)
        if margins.min() < EXCLUDED:
            mine = refine(part, start(part, _one_snapshot(pose), labels[None]), STAGES[:1])
            margins = _least_margins(part, mine, shifted)
            for k in np.flatnonzero(margins < EXCLUDED):
                rows = np.array([k])
                rival = refine(part, start(part, where.select(rows), shifted[rows]), STAGES[:1])
                margins[k] = _margin(part, mine, rival)
    return list(zip(margins.tolist(), shifted[:, 0], strict=True))


def _prefer_shifts(
    labels: NDArray[np.int64], alone: list[tuple[float, int, NDArray[np.int64]]]
) -> NDArray[np.int64] | None:
    """Labels (C, N) with the shift that each camera prefers; None = no camera prefers a shift."""
    together, least = labels.copy(), np.zeros(len(labels))
    for margin, camera, shifted in alone:
        if margin < least[camera]:
            together[camera], least[camera] = shifted[camera], margin
    return together if (least < 0).any() else None


def _one_snapshot(pose: RigidTransform) -> Poses:
    return Poses(pose.rotation.numpy()[None], pose.translation.numpy()[None])


def _explain_too_many_blobs(scene: Scene) -> str:
    name = scene.rig.camera_names[int(scene.blobs.count.argmax())]
    return (
        f"too many blobs: found {scene.blobs.count.max()} in camera {name}, where an object of "
        f"{scene.obj.num_fiducials} fiducials is expected; raise the detection threshold, or mask what is not a marker"
    )


def _refuse(scene: Scene, reason: str) -> Identity:
    labels = np.full(scene.blobs.rows, -1, dtype=np.int64)
    return Identity(labels, None, None, "refused", 0, 0.0, reason)


def _bounds(scene: Scene, distance: float, pose_known: bool) -> tuple[float, float]:
    """Maximum errors (px) of a fiducial within the pattern, and of the pattern's place.

    Both follow from the prior. A pose from one camera inherits the camera's error, and its depth that of the focal
    length, which shifts the images of cameras elsewhere.
    """
    pattern, focal = scene.known.spread.at(distance), scene.known.focal_length
    parallax = 2 * pattern.shape * focal * scene.known.baseline / distance
    shift = float(np.hypot(pattern.shift.max() * (1.0 if pose_known else np.sqrt(2)), 0.0 if pose_known else parallax))
    bend = 2.5 * pattern.shape if pose_known else float(np.hypot(2.5 * pattern.shape, APPROXIMATE))
    return max(3.0, bend * focal * scene.obj.size / distance), max(10.0, 4 * shift)


def _guess_distance(scene: Scene) -> float:
    """Distance (mm) at which the object looks about as large as the cloud of blobs."""
    focal = scene.rig.focal_length.numpy().mean(-1)
    guesses = []
    for camera in np.flatnonzero(scene.blobs.count >= 4):
        uv = scene.blobs.ideal[camera, : scene.blobs.count[camera]]
        middle = np.sort(uv, axis=0)[[(len(uv) - 1) // 2, len(uv) // 2]].mean(0)  # quicker than np.median
        away = np.hypot(*(uv - middle).T)  # may be huge if the lens is far from the truth
        guesses.append(focal[camera] * scene.obj.size / max(float(away.mean()), 1.0))
    return float(np.median(guesses))


def _usual_distance(known: Known, poses: Poses) -> float:
    """Median distance (mm) of the cameras from the object at the first of some poses."""
    centre = poses.rotation[0] @ known.points.mean(0) + poses.translation[0]
    return median(np.linalg.norm(known.shared.position - centre, axis=1))
