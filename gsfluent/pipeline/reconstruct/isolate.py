"""Tell the object from what it stands on and what lies behind it."""

from __future__ import annotations

import logging
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from gsfluent.data import BACKGROUND, SURFACE, Capture, Gaussians
from gsfluent.errors import InputError
from gsfluent.geometry import normalize_quaternions, quaternion_to_matrix
from gsfluent.pipeline.capture.hull import focus_point
from gsfluent.pipeline.stage import Stage
from gsfluent.progress import Progress, report_progress

_log = logging.getLogger(__name__)

_FAINT = 0.1  # opacity below which a splat says nothing about where matter is
_GRID = 64  # cells per side of the connectivity grid


@dataclass(frozen=True)
class Plane:
    """A support plane: ``normal @ x = offset``, the normal pointing to the cameras' side."""

    normal: Tensor
    offset: float
    share: float

    def height(self, points: Tensor) -> Tensor:
        """Signed height of points [N, 3] above the plane, [N]."""
        return points @ self.normal.to(points) - self.offset


class Isolate(Stage):
    """Split a reconstruction into the object and its background.

    Args:
        method: How to find the object. "auto" takes the labels of the splats when some are
            ``BACKGROUND``, else masks when the capture has them, else "plane"; without a capture it
            keeps everything. "labels": splats not labelled ``BACKGROUND``.
            "masks": splats that lie in the masks of most views. "box": splats in ``box``. "plane":
            what stands above the support plane (when there is one) near the point the cameras look
            at and hangs together. "all": everything.
        box: Lower and upper corner in world units, for "box".
        radius: Radius of the region of interest [world units]; by default from the cameras.
        margin: Height above the plane below which splats count as table, as a share of the radius.
        seed: Seed of RANSAC.

    Raises:
        InputError: An unknown method, or "box" without a box.
    """

    name = "isolate"

    def __init__(
        self,
        method: str = "auto",
        *,
        box: tuple[Sequence[float], Sequence[float]] | None = None,
        radius: float | None = None,
        margin: float = 0.025,
        seed: int = 0,
    ) -> None:
        super().__init__(seed=seed)
        if method not in ("auto", "labels", "masks", "box", "plane", "all"):
            raise InputError(
                f"isolate.method {method!r} is not known",
                "choose auto, labels, masks, box, plane or all",
            )
        if method == "box" and box is None:
            raise InputError("isolate: method box needs a box", "give its two corners")
        if box is not None and not all(low < high for low, high in zip(*box, strict=True)):
            raise InputError(f"isolate: the box {box} is empty", "give lower < upper corners")
        self.method = method
        self.box = box
        self.radius = radius
        self.margin = float(margin)

    def forward(
        self,
        gaussians: Gaussians,
        capture: Capture | None = None,
        progress: Progress | None = None,
    ) -> Gaussians:
        """The object alone, its ``report`` as well; see :meth:`split`."""
        return self.split(gaussians, capture, progress)[0]

    def split(
        self,
        gaussians: Gaussians,
        capture: Capture | None = None,
        progress: Progress | None = None,
    ) -> tuple[Gaussians, Gaussians]:
        """Split ``gaussians`` into the object and the rest.

        Args:
            gaussians: A reconstruction, in the world frame of the capture.
            capture: The photographs it came from; may be None for "box" and "all".
            progress: Progress callback.

        Returns:
            The object (labels ``SURFACE``) and the background (``BACKGROUND``, may be empty);
            ``report`` of the object says what was found: method, counts, plane, radius.

        Raises:
            InputError: Nothing is left, or the method needs a capture.
        """
        method = self._method(gaussians, capture)
        if capture is None and method in ("masks", "plane"):
            raise InputError(
                f"isolate: method {method} needs the capture", "give it, or use box or all"
            )
        report_progress(progress, 0, 1, f"isolate by {method}")
        report: dict[str, Any] = {"method": method}
        if method == "all":
            keep = torch.ones(gaussians.count, dtype=torch.bool, device=gaussians.device)
        elif method == "labels":
            if gaussians.labels is None:
                raise InputError("isolate: the splats have no labels", "choose another method")
            keep = gaussians.labels != BACKGROUND
        elif method == "box":
            assert self.box is not None
            corners = torch.tensor(self.box, dtype=gaussians.dtype, device=gaussians.device)
            means = gaussians.means
            keep = ((means >= corners[0]) & (means <= corners[1])).all(1)
        elif method == "masks":
            assert capture is not None
            keep = _in_masks(gaussians, capture)
        else:
            assert capture is not None
            keep, found_by = self._standing(gaussians, capture)
            report |= found_by
        if not bool(keep.any()):
            raise InputError(
                f"isolate: method {method} found no object among {gaussians.count} Gaussians",
                "give masks, or a box around the object (isolate: {method: box})",
            )
        report_progress(progress, 1, 1, f"{int(keep.sum())} Gaussians are object")
        report |= {"object": int(keep.sum()), "background": int((~keep).sum())}
        rest = gaussians.select(~keep).labelled(BACKGROUND)
        found = gaussians.select(keep).replace(report=report)
        if method in ("all", "labels") and found.labels is not None:
            return found, rest  # they say more than this stage knows
        return found.labelled(SURFACE), rest

    def _method(self, gaussians: Gaussians, capture: Capture | None) -> str:
        if self.method != "auto":
            return self.method
        if gaussians.labels is not None and bool((gaussians.labels == BACKGROUND).any()):
            return "labels"
        if capture is None:
            return "all"
        return "masks" if capture.shows_masks() else "plane"

    def _standing(self, gaussians: Gaussians, capture: Capture) -> tuple[Tensor, dict[str, Any]]:
        """Splats above the support plane, in the focus region, connected to its middle; notes."""
        viewmats = torch.stack([camera.viewmat for camera in capture.cameras])
        middle = focus_point(viewmats)
        radius = self.radius or _focus_radius(capture, middle)
        means = gaussians.means.cpu().double()
        solid = (gaussians.opacities > _FAINT).cpu()
        small = (gaussians.scales.amax(1) < 0.25 * radius).cpu()
        near = (means - middle).norm(dim=1) < radius
        plane = self._support(capture, means[solid & small], middle, radius)
        notes: dict[str, Any] = {
            "radius": radius,
            "focus": [round(float(v), 4) for v in middle],
        }
        keep = near & small
        if plane is not None:
            notes["plane"] = {
                "normal": [round(float(v), 4) for v in plane.normal],
                "offset": round(plane.offset, 5),
                "share": round(plane.share, 3),
            }
            keep &= plane.height(means) > self.margin * radius
        keep = _connected(gaussians, keep, solid, middle, radius)
        return keep.to(gaussians.device), notes

    def _support(
        self, capture: Capture, means: Tensor, middle: Tensor, radius: float
    ) -> Plane | None:
        """The plane most points around the focus lie on, if the cameras are all above it."""
        points = capture.points.cpu().double()
        points = points[(points - middle).norm(dim=1) < radius]
        if len(points) < 300:  # triangulated points lie truer than splats, when there are enough
            points = torch.cat([points, means[(means - middle).norm(dim=1) < radius]])
        if len(points) < 100:
            return None
        plane = find_plane(points, capture.centers(), 0.015 * radius, self.seed)
        if plane is None:
            return None
        focus_height = float(plane.height(middle[None])[0])
        above = plane.height(points) > self.margin * radius
        below = plane.height(points) < -self.margin * radius
        # A table carries the object: the focus lies above it, little lies below it nearby.
        if focus_height < -0.3 * radius or int(below.sum()) > int(above.sum()):
            _log.info("no support plane: the best plane does not carry what the cameras look at")
            return None
        return plane


def find_plane(points: Tensor, cameras: Tensor, tolerance: float, seed: int = 0) -> Plane | None:
    """Largest plane through points [N, 3] that has all cameras [C, 3] on one side (RANSAC).

    Args:
        points: Points, float64.
        cameras: Camera positions.
        tolerance: Distance within which a point lies on the plane.
        seed: Seed of the draws.

    Returns:
        The plane refined by least squares over its inliers, or None when no plane holds an eighth
        of the points.
    """
    rng = np.random.default_rng(seed)
    cloud = points.numpy()
    if len(cloud) > 6000:
        cloud = cloud[rng.choice(len(cloud), 6000, replace=False)]
    eyes = cameras.cpu().double().numpy()
    best, normal, offset = 0, np.zeros(3), 0.0
    for _ in range(600):
        a, b, c = cloud[rng.choice(len(cloud), 3, replace=False)]
        candidate = np.cross(b - a, c - a)
        length = np.linalg.norm(candidate)
        if length < 1e-12:
            continue
        candidate /= length
        side = eyes @ candidate - a @ candidate
        if not (np.all(side > 0) or np.all(side < 0)):
            continue
        count = int((np.abs(cloud @ candidate - a @ candidate) < tolerance).sum())
        if count > best:
            sign = 1.0 if side[0] > 0 else -1.0
            best, normal, offset = count, sign * candidate, sign * float(a @ candidate)
    if best < len(cloud) / 8:
        return None
    for _ in range(3):
        inlier = cloud[np.abs(cloud @ normal - offset) < tolerance]
        center = inlier.mean(0)
        refined = np.linalg.svd(inlier - center, full_matrices=False)[2][2]
        normal = refined if refined @ normal > 0 else -refined
        offset = float(center @ normal)
    share = float((np.abs(cloud @ normal - offset) < tolerance).mean())
    return Plane(torch.from_numpy(normal.copy()), offset, share)


def _focus_radius(capture: Capture, middle: Tensor) -> float:
    """Radius of the sphere around the focus that the wider field of view just holds."""
    radius = []
    for camera in capture.cameras:
        distance = float((camera.center() - middle).norm())
        half = 0.5 * max(
            camera.width / float(camera.K[0, 0]), camera.height / float(camera.K[1, 1])
        )
        radius.append(distance * math.sin(math.atan(half)))
    return float(np.median(radius))


def _in_masks(gaussians: Gaussians, capture: Capture) -> Tensor:
    """Splats whose centre lies in the mask in at least 80 % of the views that see it."""
    means = gaussians.means.cpu().double()
    hit, seen = torch.zeros(len(means)), torch.zeros(len(means))
    for index in range(len(capture)):
        view = capture.view(index, 512)
        if view.mask is None:
            continue
        pixel, depth = view.camera.project(means)
        column, row = pixel.floor().long().unbind(1)
        height, width = view.mask.shape
        on = (depth > 0) & (column >= 0) & (column < width) & (row >= 0) & (row < height)
        inside = view.mask[row.clamp(0, height - 1), column.clamp(0, width - 1)] > 0.5
        hit += (on & inside).float()
        seen += on.float()
    return ((seen > 0) & (hit >= 0.8 * seen)).to(gaussians.device)


def _connected(
    gaussians: Gaussians, keep: Tensor, solid: Tensor, middle: Tensor, radius: float
) -> Tensor:
    """Of the kept splats, those in the connected body of most opacity near the focus.

    A splat fills the grid cells of its centre and of the ends of its axes (1.5 standard
    deviations), so large neighbours touch.
    """
    from scipy import ndimage

    means = gaussians.means.cpu().double()
    axes = quaternion_to_matrix(normalize_quaternions(gaussians.quats.cpu().double()))
    axes = axes * (1.5 * gaussians.scales.cpu().double())[:, None, :]
    ends = [means + sign * axes[:, :, k] for k in range(3) for sign in (-1.0, 1.0)]

    def cells(points: Tensor) -> Tensor:
        return ((points - (middle - radius)) / (2.0 * radius) * _GRID).floor().long()

    rows = keep & solid
    index = torch.cat([cells(points[rows]) for points in (means, *ends)])
    opacity = gaussians.opacities.cpu().double()[rows].repeat(7)
    on = ((index >= 0) & (index < _GRID)).all(1)
    dense = np.zeros((_GRID,) * 3, dtype=np.float64)
    np.add.at(dense, tuple(index[on].T.numpy()), opacity[on].numpy())
    bodies, count = ndimage.label(dense > 0.3, structure=np.ones((3, 3, 3)))
    if count == 0:
        return torch.zeros_like(keep)
    cell = (np.indices(dense.shape).reshape(3, -1).T + 0.5) / _GRID * 2.0 - 1.0
    # Matter close to the focus counts more: a large far thing is not what was photographed.
    weight = dense.reshape(-1) * np.exp(-4.0 * (cell**2).sum(1))
    mass = np.bincount(bodies.reshape(-1), weights=weight, minlength=count + 1)
    mass[0] = 0.0
    body = ndimage.binary_dilation(bodies == int(mass.argmax()), iterations=1)

    def in_body(points: Tensor) -> Tensor:
        place = cells(points)
        on = ((place >= 0) & (place < _GRID)).all(1)
        return on & torch.from_numpy(body[tuple(place.clamp(0, _GRID - 1).T.numpy())])

    # Needles that stick out of the body have an end in the open.
    inside = torch.stack([in_body(points) for points in ends]).sum(0)
    return keep & in_body(means) & (inside >= 5)
