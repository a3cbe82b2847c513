"""`CalibrationObject`: known fiducials in the object's frame, and its symmetries."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from imgcal.errors import InputError
from imgcal.geometry import pose_rank, require_shapes
from imgcal.types.board import Board

ANY_LABEL = 1_000_000
"""Labels in a table of unknown markers are below this; they are ignored."""
MOST_LIGHTS = 16
"""Most markers per snapshot that a running rig learns from; if there are more, those that the most cameras see."""


@dataclass(frozen=True)
class Symmetry:
    """A rigid motion that maps fiducials of an object onto fiducials of the same object.

    An estimator that gives fiducial `i` the label `permutation[i]` sees (almost) the same points.
    """

    rotation: NDArray[np.float64]  # (3, 3)
    translation: NDArray[np.float64]  # (3,) mm: moved = rotation @ point + translation
    permutation: NDArray[np.int64]  # (N,) fiducial that each one maps to, -1 = none
    residual: float  # mm, RMS distance between the mapped fiducials and those that they map to


@dataclass(frozen=True)
class CalibrationObject:
    """Fiducials on a rigid body.

    Examples:
        >>> from renderers import palette
        >>> points = torch.tensor([[0.0, 0.0, 0.0], [50.0, 0.0, 0.0], [0.0, 80.0, 0.0], [0.0, 0.0, 120.0]])
        >>> obj = CalibrationObject(points, palette(4), radius=torch.full((4,), 5.0), name="corner")
        >>> obj.num_fiducials, obj.exact, obj.planar
        (4, True, False)
    """

    points: Tensor  # (N, 3) mm in the object's frame
    colours: Tensor  # (N, 3) in [0, 1], for colour-coded rendering
    radius: Tensor | None = None  # (N,) mm of spherical fiducials; None = points
    name: str = "object"
    fiducial_names: tuple[str, ...] = field(default=())
    tolerance: Tensor | None = None  # (N,) mm, one standard deviation of each coordinate; None = exact
    scale_tolerance: float = 0.0  # relative, one standard deviation of all distances together
    board: Board | None = None  # the printed pattern whose points these are; None = markers
    modes: Tensor | None = None  # (K, N, 3) mm: deformations with standard normal coefficients; None = rigid
    labels: tuple[int, ...] = ()  # of the fiducials in tables; empty = their row numbers
    unknown_markers: bool = False  # any blob may be a separate marker: see `unknown`
    parts: tuple[CalibrationObject, ...] = ()  # several objects, see `of_several` and `as_unknown`; empty = one object
    origin: Tensor | None = None  # (3,) mm in the frame of the object's file: the origin of `points`; None = the same

    def __repr__(self) -> str:
        """Summarize: `CalibrationObject('cube8': 8 fiducials)`; points, radii and tolerances are attributes."""
        if self.unknown_markers:
            return f"CalibrationObject({self.name!r}: unknown markers)"
        if self.parts:
            return f"CalibrationObject({', '.join(map(repr, self.parts))})"
        exact = "" if self.tolerance is None else ", with tolerances"
        return f"CalibrationObject({self.name!r}: {len(self.points)} fiducials{exact})"

    def __post_init__(self) -> None:
        if not isinstance(self.points, Tensor):
            raise InputError(f"object {self.name}: found points in a {type(self.points).__name__}, expected a tensor")
        if self.points.ndim != 2 or self.points.shape[1] != 3 or len(self.points) < 1:
            raise InputError(
                f"object {self.name}: found points of shape {tuple(self.points.shape)}, expected (N >= 1, 3)"
            )
        if self.radius is not None:
            require_shapes(f"object {self.name}", [("radius", self.radius, (len(self.points),))])
        if self.tolerance is not None and (
            self.tolerance.shape != (len(self.points),)
            or not bool(((self.tolerance >= 0) & self.tolerance.isfinite()).all())
        ):
            raise InputError(
                f"object {self.name}: expected a tolerance >= 0 (mm) for each of {len(self.points)} fiducials"
            )
        if self.modes is not None and self.modes.shape[1:] != self.points.shape:
            found = tuple(self.modes.shape)
            raise InputError(f"object {self.name}: found modes of shape {found}, expected (K, {len(self.points)}, 3)")
        if not 0 <= self.scale_tolerance < 1:
            raise InputError(
                f"object {self.name}: found a scale tolerance of {self.scale_tolerance}, expected a share from 0 to 1"
            )

    @classmethod
    def of_board(cls, board: Board, name: str = "board") -> CalibrationObject:
        """Make an object from a printed board."""
        from renderers import palette

        points, modes = torch.from_numpy(board.points), torch.from_numpy(board.modes)
        colours = palette(len(points)).double()
        return cls(points, colours, name=name, board=board, modes=modes if len(modes) else None)

    @classmethod
    def unknown(cls, name: str = "lights", most: int = 1) -> CalibrationObject:
        """Make an object of unknown markers: any blob may be a separate marker at an unknown position.

        In a capture, each marker at each moment is an object of one point. A running rig numbers the markers of a
        moment: its object has a point for each number. The pose is a transform (S, N) whose translation is the position
        of marker n, nan for unused numbers.

        Args:
            name: of the object.
            most: largest number of markers at one moment, N.

        Examples:
            >>> lights = CalibrationObject.unknown(most=4)
            >>> lights.num_fiducials, lights.pose_rank, lights.exact
            (4, 3, True)
        """
        points, colours = torch.zeros(most, 3).double(), torch.ones(most, 3).double()
        return cls(points, colours, name=name, unknown_markers=True)

    def as_unknown(self) -> CalibrationObject:
        """Replace an object by unknown markers, as a running rig does unless it is a single rigid body.

        Returns:
            Up to `MOST_LIGHTS` markers at once, or as many as the objects have, with the object's radius if all
            fiducials have the same. The fiducials of sticks and of several objects come first: their `parts` say
            how far apart they are. A single rigid body is returned unchanged.

        Examples:
            >>> stick = torch.tensor([[0.0, 0.0, 0.0], [500.0, 0.0, 0.0]])
            >>> watched = CalibrationObject(stick, torch.ones(2, 3), name="stick").as_unknown()
            >>> watched, watched.num_fiducials, [part.num_fiducials for part in watched.parts]
            (CalibrationObject('stick': unknown markers), 18, [2, 16])
        """
        if len(self.points) > 1 and (self.unknown_markers or (not self.parts and self.pose_rank == 6)):
            return self
        known = [part for part in self.each if part.pose_rank > 3]
        count = sum(part.num_fiducials for part in known)
        lights = CalibrationObject.unknown(self.name, max(MOST_LIGHTS, count))
        if self.radius is not None and bool((self.radius == self.radius[0]).all()):
            lights = replace(lights, radius=self.radius[:1].double().expand(len(lights.points)).clone())
        if not known:
            return lights
        found = CalibrationObject.unknown(self.name, count + len(lights.points))
        radius = None if lights.radius is None else lights.radius[:1].expand(len(found.points)).clone()
        return replace(found, radius=radius, parts=(*known, lights))

    @classmethod
    def of_several(cls, objects: Sequence[CalibrationObject]) -> CalibrationObject:
        """Put the fiducials of several objects into one set, for captures in which any of them may be visible.

        Each object has its own pose, so do not project the whole set with one pose. A snapshot becomes one row for each
        object, and a row uses only the columns of its own object.

        Args:
            objects: at least one; objects of the same name are numbered. A single object is returned unchanged. One of
                several may be a single marker or unknown markers, which are treated alike: any number may be in view.

        Returns:
            All fiducials in the order of the objects, unknown markers last. Coordinates are relative to the centroid of
            each object; `parts` holds the objects with these coordinates.

        Raises:
            InputError: a printed board or an object with a scale tolerance among several, or single or unknown markers
                twice.

        Examples:
            >>> import imgcal
            >>> wand, cube = imgcal.load_object("wand4"), imgcal.load_object("cube8")
            >>> both = CalibrationObject.of_several([wand, cube, cube])
            >>> both.num_fiducials, [part.name for part in both.parts]
            (20, ['wand4', 'cube8', 'cube8-2'])
        """
        if len(objects) == 1:
            return objects[0]
        if not objects:
            raise InputError("objects: found none, expected at least one")
        for obj in objects:
            found = (
                "a printed board" if obj.board is not None else
                "a scale tolerance" if obj.scale_tolerance else ""
            )  # fmt: skip
            if found:
                raise InputError(f"object {obj.name}: found {found}, expected none among several objects")
        lights = [replace(obj, unknown_markers=True) for obj in objects if obj.pose_rank == 3]
        objects = [obj for obj in objects if obj.pose_rank > 3] + lights
        if len(lights) > 1:
            raise InputError("objects: found single or unknown markers twice, expected once, for any number of them")
        names: list[str] = []
        for obj in objects:
            number = sum(other.name == obj.name for other in objects[: len(names)]) + 1
            names.append(obj.name if number == 1 else f"{obj.name}-{number}")
        parts = tuple(obj.about_centroid(name) for obj, name in zip(objects, names, strict=True))
        has_radius = any(part.radius is not None for part in parts)
        has_tolerance = any(part.tolerance is not None for part in parts)
        return cls(
            torch.cat([part.points for part in parts]),
            torch.cat([part.colours for part in parts]),
            torch.cat([_radius_or_zero(part.radius, part.points) for part in parts]) if has_radius else None,
            " + ".join(names),
            tolerance=torch.cat([part.granted for part in parts]) if has_tolerance else None,
            parts=parts,
        )

    def about_centroid(self, name: str) -> CalibrationObject:
        """Move the origin to the centroid of the fiducials, and name the object; `origin` says where it was."""
        points = self.points.double()
        centroid = points.mean(0)
        origin = centroid if self.origin is None else centroid + self.origin
        return replace(self, name=name, points=points - centroid, origin=origin)

    @property
    def each(self) -> tuple[CalibrationObject, ...]:
        """The individual objects: `parts`, or the object itself."""
        return self.parts or (self,)

    @cached_property
    def part_of(self) -> NDArray[np.int64]:
        """Index of the object that each fiducial belongs to: (N,); zeros for a single object."""
        return np.repeat(np.arange(len(self.each)), [len(part.points) for part in self.each])

    @property
    def known_parts(self) -> tuple[tuple[int, NDArray[np.float64]], ...]:
        """Known objects among unknown markers: the number of the first fiducial of each, and its points (n, 3) mm."""
        if not self.unknown_markers or not self.parts:
            return ()
        points = [part.points.double().numpy() for part in self.parts[:-1]]
        first = np.cumsum([0, *map(len, points)]).tolist()
        return tuple(zip(first, points, strict=False))

    @property
    def has_lights(self) -> bool:
        """Tell whether the last of several objects stands for unknown markers."""
        return bool(self.parts) and self.parts[-1].unknown_markers

    @property
    def exact(self) -> bool:
        """Tell whether the fiducials are where the object says, without any tolerance."""
        return self.scale_tolerance == 0 and (self.tolerance is None or not bool(self.tolerance.any()))

    def require_rigid(self, use: str) -> None:
        """Refuse several objects, sticks, and single or unknown markers where they are not supported yet.

        Args:
            use: what the object is for, in words.

        Raises:
            InputError: several objects, unknown markers, only one fiducial, or all fiducials on one line.
        """
        if self.parts:
            raise InputError(f"objects: found {len(self.parts)}, expected a single one {use}")
        if self.unknown_markers:
            found = "found unknown markers, expected the file of an object"
            raise InputError(f"object {self.name}: {found} {use}")
        if self.pose_rank < 6:
            found = "one fiducial" if len(self.points) == 1 else f"{len(self.points)} fiducials on one line"
            raise InputError(f"object {self.name}: found {found}, expected some that are not on one line {use}")

    @property
    def granted(self) -> Tensor:
        """Tolerance of each fiducial, (N,) mm: zero where none is given."""
        return torch.zeros_like(self.points[:, 0]) if self.tolerance is None else self.tolerance

    def as_exact(self) -> CalibrationObject:
        """Return the object without its tolerances and modes."""
        soft = self.modes is not None or not self.exact
        parts = tuple(part.as_exact() for part in self.parts)
        return replace(self, tolerance=None, scale_tolerance=0.0, modes=None, parts=parts) if soft else self

    @property
    def num_fiducials(self) -> int:
        """Number of fiducials, N."""
        return len(self.points)

    @property
    def rows(self) -> int | tuple[int, ...] | tuple[tuple[str, int], ...]:
        """Labels of the fiducials in tables: the number of rows, or explicit labels; for several objects, with names.

        Unknown markers may have any label.
        """
        if self.unknown_markers:
            return ANY_LABEL
        if self.parts:
            return tuple(
                (part.name, label) for part in self.parts for label in part.labels or range(part.num_fiducials)
            )
        return self.labels or self.num_fiducials

    @cached_property
    def size(self) -> float:
        """RMS distance of the fiducials from their centroid, mm."""
        return float((self.points - self.points.mean(0)).square().sum(1).mean().sqrt())

    @cached_property
    def pose_rank(self) -> int:
        """Observable degrees of freedom of its pose: 3 for a single marker, 5 for collinear fiducials, else 6.

        For several objects, the largest.
        """
        if self.unknown_markers:
            return 3
        return max(part.pose_rank for part in self.parts) if self.parts else pose_rank(self.points)

    @cached_property
    def planar(self) -> bool:
        """Tell whether all fiducials lie in one plane (to 1e-3 of the object's size)."""
        singular = torch.linalg.svdvals((self.points - self.points.mean(0)).double())
        return len(singular) < 3 or bool(singular[2] < 1e-3 * singular[0])

    @cached_property
    def symmetries(self) -> tuple[Symmetry, ...]:
        """Proper rotations that map the object onto itself, the identity first; computed on first use.

        If there are several, unlabelled blobs cannot distinguish them. The relative poses of the cameras are the same
        for all, as long as every camera uses the same one.
        """
        return self.near_symmetries(tolerance=1e-3 * self.size)

    def near_symmetries(self, tolerance: float) -> tuple[Symmetry, ...]:
        """Find rotations about the centroid that map every fiducial to within `tolerance` (mm) of one of equal radius.

        Returns:
            Symmetries in order of residual, the identity first; `permutation` has no -1. For several objects, only the
            identity: call this for each of them.

        Source: every symmetry of a finite set fixes its centroid and is determined by the images of two points that are
        not collinear with it.
        """
        if self.parts:
            return (Symmetry(np.eye(3), np.zeros(3), np.arange(self.num_fiducials), 0.0),)
        points = (self.points - self.points.mean(0)).double().cpu().numpy()
        radius = np.zeros(len(points)) if self.radius is None else self.radius.double().cpu().numpy()
        rotations = _turns_to_try(points, self.pose_rank, tolerance)
        moved = points @ rotations.transpose(0, 2, 1)  # (R, N, 3)
        found: dict[bytes, Symmetry] = {}
        centroid = self.points.mean(0).double().cpu().numpy()
        for rotation, image in zip(rotations, moved, strict=True):
            distance = np.linalg.norm(image[:, None] - points[None], axis=-1)
            permutation = distance.argmin(1)
            nearest = distance[np.arange(len(points)), permutation]
            proper = len(np.unique(permutation)) == len(points) and np.allclose(radius[permutation], radius)
            if nearest.max() > tolerance or not proper:
                continue
            residual = float(np.sqrt(np.mean(nearest**2)))
            known = found.get(permutation.tobytes())
            if known is None or residual < known.residual:
                motion = Symmetry(rotation, centroid - rotation @ centroid, permutation, residual)
                found[permutation.tobytes()] = motion
        identity = np.arange(len(points)).tobytes()
        rest = sorted((m for key, m in found.items() if key != identity), key=lambda m: m.residual)
        return (Symmetry(np.eye(3), np.zeros(3), np.arange(len(points)), 0.0), *rest)


def _radius_or_zero(radius: Tensor | None, points: Tensor) -> Tensor:
    """Radii (N,) mm of fiducials; zeros for points."""
    return torch.zeros_like(points[:, 0]) if radius is None else radius.to(points)


def _turns_to_try(points: NDArray[np.float64], rank: int, tolerance: float) -> NDArray[np.float64]:
    """Candidate rotations (R, 3, 3) of centred points (N, 3) onto each other; for a stick, half a turn."""
    if rank == 6:
        return _rotations_of_pairs(points, _base_pair(points), tolerance)
    if rank == 3:
        return np.eye(3)[None]
    along = points[int(np.linalg.norm(points, axis=1).argmax())]
    across = np.cross(along, np.eye(3)[int(np.abs(along).argmin())])
    across /= np.linalg.norm(across)
    return np.stack((np.eye(3), 2 * np.outer(across, across) - np.eye(3)))


def _base_pair(points: NDArray[np.float64]) -> tuple[int, int]:
    """Two points far from the centroid (at the origin) and far from collinear with it."""
    first = int(np.linalg.norm(points, axis=1).argmax())
    second = int(np.linalg.norm(np.cross(points, points[first]), axis=1).argmax())
    if np.linalg.norm(np.cross(points[second], points[first])) < 1e-6 * np.sum(points[first] ** 2):
        raise InputError("object: all fiducials lie on one line; a pose cannot be found from them")
    return first, second


def _rotations_of_pairs(points: NDArray[np.float64], base: tuple[int, int], tolerance: float) -> NDArray[np.float64]:
    """Rotations (R, 3, 3) about the origin that take the base pair to within `tolerance` of some pair of points."""
    a, b = points[base[0]], points[base[1]]
    norms = np.linalg.norm(points, axis=1)
    like_a = np.flatnonzero(np.abs(norms - np.linalg.norm(a)) <= tolerance)
    like_b = np.flatnonzero(np.abs(norms - np.linalg.norm(b)) <= tolerance)
    gaps = np.linalg.norm(points[like_a][:, None] - points[like_b][None], axis=-1)
    i, j = np.nonzero(np.abs(gaps - np.linalg.norm(a - b)) <= 2 * tolerance)
    source = _frame(a[None], b[None])
    target = _frame(points[like_a[i]], points[like_b[j]])
    return target @ source.transpose(0, 2, 1)


def _frame(first: NDArray[np.float64], second: NDArray[np.float64]) -> NDArray[np.float64]:
    """Orthonormal frames (R, 3, 3), columns spanned by two vectors (R, 3) each."""
    x = first / np.linalg.norm(first, axis=1, keepdims=True)
    z = np.cross(first, second)
    z = z / np.maximum(np.linalg.norm(z, axis=1, keepdims=True), 1e-300)
    return np.stack((x, np.cross(z, x), z), axis=-1)
