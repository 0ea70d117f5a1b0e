"""Masks for a capture that has none: silhouettes of the object found in a first reconstruction."""

from __future__ import annotations

import logging
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from gsfluent.data import Gaussians
from gsfluent.draw import draw_at
from gsfluent.pipeline.capture.hull import Hull, contradiction, visual_hull
from gsfluent.pipeline.capture.views import TrainView, cropped

_REACH = 0.018  # of the longer side: how far the border of a silhouette may be wrong
_ROUNDS = 3
_SMALLEST_BODY = 40  # pixels


@torch.no_grad()
def silhouette(
    found: Gaussians, rest: Gaussians, viewmat: Tensor, K: Tensor, width: int, height: int
) -> Tensor:
    """Share of each pixel that shows the object, behind whatever of the rest stands before it.

    Args:
        found: The object.
        rest: Everything else.
        viewmat: World to camera [4, 4].
        K: Intrinsics [3, 3].
        width: Image width [px].
        height: Image height [px].

    Returns:
        Values in [0, 1], shape [H, W].
    """
    both = Gaussians.cat([found, rest])
    flag = torch.cat([torch.ones_like(found.opacities), torch.zeros_like(rest.opacities)])
    seen = draw_at(both, viewmat, K, (width, height), colors=flag[:, None].contiguous())
    return seen.image[..., 0]


def refined_mask(share: Tensor, image: Tensor, *, inner: float = 1.0) -> Tensor | None:
    """Mask of the object from a rough silhouette and the photograph.

    Args:
        share: Rough share of the object per pixel, [H, W].
        image: The photograph, [H, W, 3] in [0, 1].
        inner: How much more the silhouette may be too large than too small.

    Returns:
        One closed body with soft edges, [H, W], or None when the silhouette is all but empty.
    """
    import cv2
    from scipy import ndimage

    values = share.numpy()
    reach = max(3, round(_REACH * max(values.shape)))
    body = ndimage.binary_fill_holes(ndimage.binary_opening(values > 0.5))
    if int(body.sum()) < _SMALLEST_BODY:
        return None
    trimap = np.where(body, cv2.GC_PR_FGD, cv2.GC_PR_BGD).astype(np.uint8)
    trimap[ndimage.binary_erosion(body, iterations=round(inner * reach))] = cv2.GC_FGD
    trimap[~ndimage.binary_dilation(values > 0.3, iterations=reach)] = cv2.GC_BGD
    known = np.isin(trimap, (cv2.GC_BGD, cv2.GC_PR_BGD))
    if bool(known.any()) and not bool(known.all()):
        pixels = np.ascontiguousarray((image.numpy()[..., ::-1] * 255).astype(np.uint8))
        cv2.setRNGSeed(0)
        behind, before = np.zeros((1, 65)), np.zeros((1, 65))
        box = (0, 0, 1, 1)  # not read in this mode
        cv2.grabCut(pixels, trimap, box, behind, before, _ROUNDS, cv2.GC_INIT_WITH_MASK)
        body = np.isin(trimap, (cv2.GC_FGD, cv2.GC_PR_FGD))
    pieces, count = ndimage.label(ndimage.binary_opening(body))
    if count == 0:
        return None
    sizes = np.bincount(pieces.reshape(-1))
    sizes[0] = 0
    if int(sizes.max()) < _SMALLEST_BODY:
        return None
    body = ndimage.binary_fill_holes(pieces == int(sizes.argmax()))
    soft = cv2.GaussianBlur(body.astype(np.float32), (3, 3), 0.6)
    return torch.from_numpy(soft)


_log = logging.getLogger(__name__)


_MANY = 24  # views that carry a hull even when some silhouettes are distrusted
_FORGIVEN = 0.1  # share of many silhouettes that may be wrong about a voxel
_FORGIVEN_MORE = 0.2  # the same where many are known to be wrong
_CONTRADICTION = 0.02  # of the hull denied by a silhouette before it is distrusted
_ALLOWED = 0.12  # the same after masks were made again
_WORTH = 0.2  # share of distrusted silhouettes from which they are made again, not left out
_INNER = 4.0  # a hull is too large rather than too small
_AGAIN = 2
_FORGIVEN_HULL = (0.05, 0.1)  # tried in turn where poses contradict masks


_BARE = 0.03  # of the masks that a good hull may leave uncovered
_LOOKS = 24  # views that tell which background shows
_SHOWN = 0.1  # of its weight without the object: a splat that shows less is hidden


def object_views(
    views: list[TrainView], found: Gaussians, rest: Gaussians
) -> tuple[list[TrainView], dict[str, int]]:
    """The photographs cut to the object, with masks that agree; the others are left out.

    The object's rendered silhouette says roughly where it is and GrabCut moves its border to where
    the colours change. With 24 views or more, a mask that denies over 2 % of the hull of the others
    is left out; where these are many, they are made again from the hull's own picture first.

    Args:
        views: Whole photographs.
        found: The object as first found.
        rest: Everything else.

    Returns:
        Masked, cropped views, and counts: ``shown`` (photographs that show the object),
        ``corrected``, ``left_out``.
    """
    masks: list[Tensor | None] = []
    for view in views:
        width, height = view.size
        share = silhouette(found, rest, view.viewmat, view.K, width, height)
        masks.append(refined_mask(share.cpu(), view.color.cpu()))
    counts = {"shown": sum(mask is not None for mask in masks), "corrected": 0, "left_out": 0}
    if counts["shown"] < _MANY:
        return _cut(views, masks), counts
    wrong = _wrong(views, masks, _CONTRADICTION)
    corrected = 0
    for _ in range(_AGAIN):
        if len(wrong) < _WORTH * len(views):
            break
        hull = visual_hull(_cut(views, masks), forgiven=_FORGIVEN_MORE)
        for index in wrong:
            view = views[index]
            share = hull_silhouette(hull, view).cpu()
            again = refined_mask(share, view.color.cpu(), inner=_INNER)
            if again is not None:
                masks[index] = again
        corrected = corrected or len(wrong)
        # A hull that forgives is too large: what was seen with care may take a little off it.
        wrong = _wrong(views, masks, _ALLOWED)
    kept = [None if index in wrong else mask for index, mask in enumerate(masks)]
    agreeing = sum(mask is not None for mask in kept)
    if agreeing < max(3, counts["shown"] // 2):
        kept, agreeing = masks, counts["shown"]
    counts |= {"corrected": corrected, "left_out": counts["shown"] - agreeing}
    _log.info("%d of %d silhouettes agree, %d made again", agreeing, len(views), corrected)
    return _cut(views, kept), counts


def agreed_hull(views: list[TrainView]) -> Hull:
    """The visual hull; where poses are off, as few views as needed are forgiven.

    A hull of exact masks and poses covers every mask. When it leaves over 3 % of them bare, parts
    were cut off that several views show; with 24 views or more some may then be wrong.

    Args:
        views: Masked views.

    Raises:
        InputError: The masks have no common object.
    """
    hull = visual_hull(views)
    if len(views) < _MANY:
        return hull
    for forgiven in _FORGIVEN_HULL:
        bare = sum(_bare(hull, view) for view in views) / len(views)
        if bare < _BARE:
            break
        _log.info("the hull leaves %.1f %% of the masks bare; forgiving some", 100 * bare)
        hull = visual_hull(views, forgiven=forgiven)
    return hull


def seen_background(
    found: Gaussians, rest: Gaussians, views: list[TrainView]
) -> tuple[Gaussians, int]:
    """The background that shows while the object is there, and how many splats do not.

    What the first reconstruction left of the object hides behind and inside the one learned later;
    no photograph ever corrected it.

    Args:
        found: The object.
        rest: The background.
        views: Whole photographs.
    """
    if found.count == 0 or rest.count == 0:
        return rest, 0
    both = Gaussians.cat([rest.replace(labels=None), found.replace(labels=None)])
    alone = torch.zeros(rest.count, device=rest.device)
    shown = torch.zeros_like(alone)
    step = max(1, len(views) // _LOOKS)
    for view in views[::step]:
        alone += _blend_weights(rest, view)
        shown += _blend_weights(both, view)[: rest.count]
    hidden = (alone > 0) & (shown < _SHOWN * alone)
    return rest.select(~hidden), int(hidden.sum())


@torch.no_grad()
def _blend_weights(gaussians: Gaussians, view: TrainView) -> Tensor:
    """Sum of blend weights of each splat in one view [px], [N]."""
    flat = torch.zeros_like(gaussians.means[:, :1])
    seen = draw_at(gaussians, view.viewmat, view.K, view.size, colors=flat, contribution=True)
    weight = seen.contribution
    assert weight is not None  # asked for
    return weight


def _bare(hull: Hull, view: TrainView) -> float:
    """Share of a view's mask that the hull does not cover."""
    assert view.mask is not None  # masked views
    on = view.mask > 0.5
    return float((on & (hull_silhouette(hull, view) < 0.5)).sum()) / max(1.0, float(on.sum()))


def hull_silhouette(hull: Hull, view: TrainView) -> Tensor:
    """Pixels of a view that show the hull, 0 or 1, [H, W]: its voxels drawn as squares."""
    local = hull.points @ view.viewmat[:3, :3].T + view.viewmat[:3, 3]
    depth = local[:, 2]
    front = depth > 1e-6
    pixel = ((local @ view.K.T)[:, :2] / depth[:, None]).floor().long()
    width, height = view.size
    on = ((pixel >= 0) & (pixel < pixel.new_tensor([width, height]))).all(1) & front
    drawn = torch.zeros(height, width, device=local.device)
    x, y = pixel[on].unbind(1)
    drawn[y, x] = 1.0
    if len(x) == 0:
        return drawn
    grow = int(0.5 * hull.voxel * float(view.K[0, 0]) / float(depth[front].median()) + 0.5)
    if grow:
        drawn = functional.max_pool2d(drawn[None, None], 2 * grow + 1, 1, grow)[0, 0]
    return drawn


def _wrong(views: list[TrainView], masks: list[Tensor | None], denied: float) -> list[int]:
    """Views whose mask denies this share of the hull of the others, or shows nothing."""
    hull = visual_hull(_cut(views, masks), forgiven=_FORGIVEN)
    found = []
    for index, (view, mask) in enumerate(zip(views, masks, strict=True)):
        if mask is None:
            found.append(index)
            continue
        masked = cropped(replace(view, mask=mask.to(view.color)))
        if contradiction(hull, masked) >= denied:
            found.append(index)
    return found


def _cut(views: list[TrainView], masks: list[Tensor | None]) -> list[TrainView]:
    return [
        cropped(replace(view, mask=mask.to(view.color)))
        for view, mask in zip(views, masks, strict=True)
        if mask is not None
    ]
