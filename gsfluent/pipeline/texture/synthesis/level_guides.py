"""Guide values of voxels and of photographs' pixels on one level."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from gsfluent.colors import rgb_to_lab100
from gsfluent.pipeline.texture.synthesis.bank import LevelPhoto
from gsfluent.pipeline.texture.synthesis.guides import DepthGuide, PlacedPhoto
from gsfluent.pipeline.texture.synthesis.levels import Lattice, ObjectFields, trilinear
from gsfluent.pipeline.texture.synthesis.sections import Section

_PER_VOXEL = 0.08  # guide weight of a cell of height or of distance to the axis
_SECTION_WEIGHT = 3.0  # against the 75 values of a patch: structure leads, texture decides
_OWN_WEIGHT = 4.5  # of a user's coordinate that runs from 0 to 1, like the depth's near the skin


class LevelGuides:
    """Guide values on one level; kinds: ``depth``, ``axis``, ``height``, ``none`` and ``array``.

    The kind ``axis`` has a section, carried along whole (fibres) when ``directional``, else its
    lines only; the kind ``array`` has the user's own coordinate [X, Y, Z] on the solid's grid.
    """

    def __init__(
        self,
        kind: str,
        fields: ObjectFields,
        lattice: Lattice,
        section: Section | None,
        own: np.ndarray | None,
        directional: bool,
        depth_guide: DepthGuide,
    ) -> None:
        self.depth_guide = depth_guide
        self.directional = directional
        self._polar: Tensor | None = None
        self.kind, self.fields, self.lattice, self.section = kind, fields, lattice, section
        self.own: Tensor | None = None
        if own is not None:
            self.own = torch.from_numpy(np.asarray(own, np.float32)).to(fields.device)

    def _common(self, local: list[Tensor], depth: Tensor, picture: Tensor | None) -> Tensor:
        """Guide values [G, ...]; ``local`` are three broadcastable coordinates."""
        pitch = self.lattice.pitch
        if self.kind == "none":
            return torch.zeros_like(depth)[None]
        layered = 1.0 if self.section is None else self.section.skin
        values = [layered * self.depth_guide(depth)]
        if self.kind == "height":
            values.append((_PER_VOXEL / pitch * local[2]).expand_as(depth))
        if self.kind == "axis" and picture is not None:
            values += list(picture)
        return torch.stack(values)

    def polar(self) -> Tensor:
        """What the section carries along the axis, at this level's detail."""
        if self._polar is None:
            assert self.section is not None
            image, _, _, _ = self.section.placed.at(self.lattice.pitch)
            lab = rgb_to_lab100(torch.from_numpy(image).to(self.fields.device)).movedim(-1, 0)
            self._polar = self.section.polar(lab, self.directional)
        return self._polar

    def _carried(self, local: Tensor, depth: Tensor) -> Tensor:
        """Radius and colour in the section [n, 4], weighted."""
        assert self.section is not None
        turn, relative = self.section.locate(local, depth)
        radius = _PER_VOXEL / self.lattice.pitch * self.section.reach * relative
        colors = self.section.color(turn, relative, self.polar())
        return torch.cat([radius[:, None], _SECTION_WEIGHT * colors], 1)

    def widths(self) -> list[float]:
        """Half a cell of this level, in guide values."""
        if self.own is not None:
            return [0.05]
        per_voxel = self.lattice.pitch / max(self.fields.max_depth, 1e-6)
        return [0.5 * min(2.0 * per_voxel, 0.2), 0.5 * _PER_VOXEL]

    def base(self, guide: Tensor, reference: tuple[Tensor, Tensor], inside: Tensor) -> Tensor:
        """What the guide alone says about the colours, [3, X, Y, Z]."""
        if self.kind == "none":
            return torch.zeros(3, *inside.shape, device=guide.device)
        if self.section is not None:
            return guide[-3:] / _SECTION_WEIGHT
        flat = guide.reshape(len(guide), -1)[:, inside.reshape(-1)].T
        result = torch.zeros(3, *inside.shape, device=guide.device)
        result[:, inside] = _regress(flat, *reference, self.widths()).T
        return result

    def of_volume(self, here: dict[str, Tensor]) -> Tensor:
        """Guide values [G, X, Y, Z]."""
        local = self.lattice.local(self.fields.device)
        picture = None
        if self.section is not None:
            inside = here["inside"]
            spot = inside.nonzero()
            places = torch.stack([local[k].reshape(-1)[spot[:, k]] for k in range(3)], -1)
            picture = torch.zeros(4, *inside.shape, device=places.device)
            picture[:, inside] = self._carried(places, here["depth"][inside]).T
        if self.own is not None:
            value = self.lattice.sample(self.own[None])
            return _OWN_WEIGHT * value
        return self._common(local, here["depth"], picture)

    def of_photo(self, placed: PlacedPhoto) -> LevelPhoto:
        """The photograph at this level's pitch."""
        device = self.fields.device
        image, mask, depth, local = placed.at(self.lattice.pitch)
        lab = rgb_to_lab100(torch.from_numpy(image).to(device))
        below = torch.from_numpy(depth).to(device).float()
        place = torch.from_numpy(local).to(device)
        picture = None
        if self.section is not None:
            found = self._carried(place.reshape(-1, 3), below.reshape(-1))
            picture = found.T.reshape(4, *mask.shape)
        if self.own is not None:
            turn = torch.tensor(self.fields.rotation, dtype=torch.float32, device=device)
            center = torch.tensor(self.fields.center, dtype=torch.float32, device=device)
            guide = _OWN_WEIGHT * trilinear(self.own[None], place @ turn + center)
        else:
            guide = self._common(list(place.movedim(-1, 0)), below, picture)
        return LevelPhoto(lab, torch.from_numpy(mask).to(device), guide.movedim(0, -1).contiguous())


def _regress(query: Tensor, color: Tensor, place: Tensor, width: list[float]) -> Tensor:
    """Mean colour [n, 3] of the photographs' pixels [m, 3] near guide values [n, G], G one or two.

    Kernel regression (Nadaraya 1964; Watson 1964) on a table, read bilinearly; ``width`` is the
    bandwidth per guide value.
    """
    if len(place) > 6000:
        some = torch.linspace(0, len(place) - 1, 6000, device=place.device).long()
        color, place = color[some], place[some]
    if place.shape[1] == 1:
        place, query, width = (
            functional.pad(place, (0, 1)),
            functional.pad(query, (0, 1)),
            [*width, 1.0],
        )
    scale = torch.tensor(width[:2], device=place.device)
    place, query = place / scale, query / scale
    low = torch.minimum(place.amin(0), query.amin(0))
    high = torch.maximum(place.amax(0), query.amax(0))
    count = [min(400, max(2, int(2 * float(high[k] - low[k])))) for k in range(2)]
    lines = [torch.linspace(float(low[k]), float(high[k]), count[k]) for k in range(2)]
    grid = torch.stack(torch.meshgrid(*lines, indexing="ij"), -1).reshape(-1, 2).to(place)
    table = []
    for part in grid.split(max(1, (1 << 24) // len(place))):
        gap = torch.cdist(part, place) ** 2
        # the second, wide kernel decides where there is no pixel near
        weight = torch.exp(-0.5 * gap) + 1e-4 / (1.0 + gap) ** 2
        table.append(weight @ color / weight.sum(1, keepdim=True))
    image = torch.cat(table).T.reshape(1, 3, *count)
    at = (query - low) / (high - low).clamp(min=1e-6)
    size = torch.tensor(count, device=place.device)
    at = 2 * (at * (size - 1) + 0.5) / size - 1
    found = functional.grid_sample(
        image, at.flip(-1)[None, None], padding_mode="border", align_corners=False
    )
    return found[0, :, 0].T
