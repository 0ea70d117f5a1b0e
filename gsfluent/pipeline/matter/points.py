"""From solids to material points: sampling, masses, material rows, seeded weakness.

Gaussians are not material points: a grid cell wants 4 to 8 points whatever the number of splats,
so points are sampled from the solid's voxels which carry the splats
(:mod:`gsfluent.pipeline.matter.carry`).
"""

from __future__ import annotations

import dataclasses
import functools
import logging
import math
from collections.abc import Callable

import torch
from torch import Tensor

from gsfluent import materials, ops
from gsfluent.data import Frame, Particles, Solid
from gsfluent.data.regions import SOURCES, region_mask
from gsfluent.errors import InputError
from gsfluent.materials import Material
from gsfluent.ops.plasticity import compiled_apart, weakened
from gsfluent.pipeline.matter.brittle import brittle_rows, distinct_rows
from gsfluent.scene.parts import quaternion_to, turned
from gsfluent.scene.scene import Body, Part, Scene
from gsfluent.spatial.blue_noise import blue_cylinder

_log = logging.getLogger(__name__)

POINTS_PER_CELL = 8
MAX_PARTICLES = 8_000_000
"""Material points that a simulation refuses to exceed unless told otherwise."""
LASTING = ("elastic", "yeoh", "ogden", "von_mises")
"""Laws of matter whose points stay beside each other."""
_WAVES = 128
ALPHA_JITTER = 0.15
"""Relative half-width of the uniform weakness noise that seeds cracks (equations.md section 17)."""


@dataclasses.dataclass(frozen=True)
class Matter:
    """Everything about the material points that does not change while they move.

    Args:
        particles: The points at time 0; their positions are the rest positions.
        law: Law of each material row, int32 [M].
        params: Parameters of each material row [M, 8] (columns of
            :func:`gsfluent.ops.return_mapping`).
        ranges: First and last + 1 row of each body's points.
        spacing: Mean distance between neighbouring points of each body [m].
        dx: Grid spacing [m].
        ladder: First row of the steps from solid to liquid of each point, int32 [N]; -1 where
            there are none, None where nothing has a temperature.
    """

    particles: Particles
    law: Tensor
    params: Tensor
    ranges: tuple[tuple[int, int], ...]
    spacing: tuple[float, ...]
    dx: float
    ladder: Tensor | None = None

    @property
    def rest(self) -> Tensor:
        """Positions at time 0 [m], [N, 3]."""
        return self.particles.position

    def of_law(self, *names: str, points: Particles | None = None) -> Tensor:
        """Points whose material obeys one of these laws (:data:`gsfluent.materials.LAWS`), [N].

        As they start, or as ``points`` are now: what melts is a liquid then.
        """
        law = self.law[(points or self.particles).material.long()]
        wanted = torch.tensor([materials.LAWS[name] for name in names], device=law.device)
        return torch.isin(law, wanted.to(law.dtype))

    @functools.cached_property
    def has_field(self) -> bool:
        """Whether any row is of phase-field matter."""
        return bool((self.law == materials.LAWS["phase_field"]).any())

    @functools.cached_property
    def compiled_apart(self) -> bool:
        """Whether any row is of a law that the resident solver has no springs for."""
        return bool(compiled_apart(self.law, self.params).any())

    @property
    def viscous(self) -> bool:
        """Whether any point is of viscous solid matter."""
        return self.particles.viscous is not None

    def stored(self, points: Particles, peak: Tensor) -> Tensor:
        """Elastic energy per volume of some points, with their peaks [J/m^3], [N]."""
        law, params, row = self.law, self.params, points.material
        if self.has_field:
            wholes = weakened(law, params, row, peak)
            energy = ops.elastic_energy(points.strain, law=wholes[0], params=wholes[1])
        else:
            energy = ops.elastic_energy(points.strain, law=law, params=params, material=row)
        if points.viscous is None:
            return energy
        return ops.viscous_energy(points.viscous, energy, law=law, params=params, material=row)

    @functools.cached_property
    def brittle(self) -> Tensor:
        """Points that can break, bool [N]: only there is peak a measure of damage."""
        return self.of_law(*materials.BREAKS)


def sample_points(solid: Solid, spacing: float, *, seed: int = 0, jitter: float = 0.5) -> Tensor:
    """Sample a solid's matter on a jittered lattice.

    One point per lattice cell of edge ``spacing``, moved at random by up to a quarter of it along
    each axis (so that no lattice plane is a preferred crack), kept where its voxel is occupied.

    Args:
        solid: The filled object.
        spacing: Distance between points [world units].
        seed: Seed of the jitter, which is fixed in object space: the same solid gives the same
            points.
        jitter: Width of the jitter in spacings; without any, what cannot break moves with less
            noise of its sampling.

    Returns:
        Points [N, 3] in world coordinates, float64, ordered along x, then y, then z.

    Raises:
        InputError: The solid is thinner than the spacing everywhere, so that no point falls inside.
    """
    occupied = solid.occupancy.nonzero()
    origin = solid.origin.to("cpu", torch.float64)
    low = origin + occupied.amin(dim=0).cpu() * solid.voxel
    high = origin + (occupied.amax(dim=0).cpu() + 1) * solid.voxel
    counts = torch.ceil((high - low) / spacing).to(torch.int64).clamp(min=1)
    generator = torch.Generator().manual_seed(seed)
    start = low + 0.5 * ((high - low) - counts * spacing)
    found = []
    lattice = torch.stack(
        torch.meshgrid(torch.arange(int(counts[1])), torch.arange(int(counts[2])), indexing="ij"),
        -1,
    )
    for i in range(int(counts[0])):  # slab by slab: memory stays small for fine lattices
        cell = torch.cat([torch.full((*lattice.shape[:2], 1), i), lattice], dim=-1).reshape(-1, 3)
        noise = torch.rand(cell.shape, generator=generator, dtype=torch.float64) - 0.5
        points = start + (cell + 0.5 + jitter * noise) * spacing
        found.append(points[solid.contains(points.to(solid.occupancy.device)).cpu()])
    result = torch.cat(found)
    if result.shape[0] == 0:
        raise InputError(
            f"sampling: no material point falls inside the solid at spacing {spacing:.4g}",
            hint="use a finer quality",
        )
    return result


def build_matter(
    scene: Scene,
    dx: float,
    *,
    seed: int = 0,
    jitter: float = ALPHA_JITTER,
    device: torch.device | str = "cpu",
    max_particles: int = MAX_PARTICLES,
    inertia: bool = False,
) -> Matter:
    """Sample all bodies of a scene at :data:`POINTS_PER_CELL` points per cell of edge ``dx``.

    The mass of a body is its density times its voxel volume; each point has the same share of the
    volume (``V_object / N``), so surface cells are not over-weighted. With ``inertia`` it is shared
    out unevenly in bodies that do not break or flow (:func:`gsfluent.ops.inertial_shares`).

    Args:
        scene: The scene; it must hold at least one body.
        dx: Grid spacing [m].
        seed: Seed of point positions and weakness.
        jitter: Relative half-width of the noise on ``alpha0``.
        device: Device of the result.
        max_particles: Refuse more than this.
        inertia: Give bodies of :data:`LASTING` laws without a temperature their own moments of
            inertia on the grid.

    Raises:
        InputError: No body, too many points, or nothing inside a solid.
    """
    if not scene.bodies:
        raise InputError(
            "simulate: the scene is empty", hint="scene.add(solid, material=...) first"
        )
    for body in scene.bodies if scene.floor is not None else ():
        depth = (scene.floor or 0.0) - float(body.bounds()[0][2])
        if depth > dx:
            raise InputError(
                f"simulate: {body.name!r} starts {depth:.3g} m below the floor",
                hint="add a drop event, or give a frame that puts it on the floor",
            )
    step = dx / POINTS_PER_CELL ** (1 / 3)
    expected = sum(body.volume for body in scene.bodies) / step**3
    if expected > max_particles:
        raise InputError(
            f"simulate: about {expected:.3g} material points at dx = {dx:.3g} m, "
            f"more than {max_particles}",
            hint="use a coarser quality or raise max_particles",
        )
    tables: list[Tensor] = []
    laws: list[Tensor] = []
    groups: list[Particles] = []
    ranges: list[tuple[int, int]] = []
    spacings: list[float] = []
    done = 0
    for number, body in enumerate(scene.bodies):
        points, volume = _sample_body(body, step, seed)
        points = points[_cell_order(points, dx / body.frame.scale)]
        count = points.shape[0]
        generator = torch.Generator().manual_seed(seed + 7919 * (number + 1))
        noise = jitter * (2.0 * torch.rand(count, generator=generator) - 1.0)
        params, law, alpha, viscous = _parameters(body, points, seed, noise, dx)
        mass = params[:, 6] * (volume / count)
        if inertia:
            each = torch.full((count,), volume / count, dtype=torch.float64)
            mass = shared_out(mass, body, points, each, law, dx)
        position, velocity, affine = start_of(body, scene, points, mass)
        tables.append(params)
        laws.append(law)
        groups.append(
            Particles.at_rest(
                position.to(torch.float32),
                mass=mass.to(torch.float32),
                volume=torch.full((count,), volume / count),
                velocity=velocity.to(torch.float32),
                alpha=alpha.to(torch.float32),
                body=number,
            ).replace(
                affine=affine.to(torch.float32).expand(count, 3, 3).contiguous(),
                viscous=viscous,
            )
        )
        ranges.append((done, done + count))
        spacings.append((volume / count) ** (1 / 3))
        done += count
    everything = torch.cat([torch.cat(laws)[:, None].to(torch.float64), torch.cat(tables)], dim=1)
    unique, row = distinct_rows(everything)
    particles = (
        Particles.cat(groups).replace(material=row.to(torch.int32)).validated("simulate").to(device)
    )
    _log.info("%d material points, dx = %.4g m, %d material rows", done, dx, unique.shape[0])
    return Matter(
        particles=particles,
        law=unique[:, 0].to(torch.int32).to(device),
        params=unique[:, 1:].to(torch.float32).contiguous().to(device),
        ranges=tuple(ranges),
        spacing=tuple(spacings),
        dx=dx,
    )


def body_frame(body: Body, scene: Scene) -> Frame:
    """Return the frame that takes a body's own coordinates to where it is at time 0."""
    shift = torch.tensor(body.offset, dtype=torch.float64) + _approach(body, scene)[0]
    return Frame(body.frame.rotation, body.frame.translation + shift, body.frame.scale)


def grid_spacing(scene: Scene, cells: int) -> float:
    """Grid spacing [m] that gives the largest solid ``cells`` cells along its longest side."""
    extents = []
    for body in scene.bodies:
        low, high = body.bounds()
        extents.append((body.solid is not None, float((high - low).max())))
    if not extents:
        raise InputError(
            "simulate: the scene is empty", hint="scene.add(solid, material=...) first"
        )
    return max(extents)[1] / cells


def shared_out(
    mass: Tensor, body: Body, points: Tensor, volume: Tensor, law: Tensor, dx: float
) -> Tensor:
    """Masses by which a body that lasts turns on a grid as it should; of others as they are.

    Args:
        mass: [kg], [N].
        body: The body.
        points: In its own coordinates, [N, 3].
        volume: [m^3], float64 [N].
        law: Numbers of its laws.
        dx: Node spacing [m].
    """
    lasts = torch.isin(law, law.new_tensor([materials.LAWS[n] for n in LASTING])).all()
    if not bool(lasts) or body.temperature is not None:  # what melts flows
        return mass
    return mass * ops.inertial_shares(points * body.frame.scale, volume=volume, dx=dx)


def _sample_body(body: Body, step: float, seed: int) -> tuple[Tensor, float]:
    """Return points in the body's own coordinates, float64 [N, 3], and the volume [m^3]."""
    volume = body.volume
    if body.solid is not None:
        return sample_points(body.solid, step / body.frame.scale, seed=seed), volume
    # A ball is never coarser than four points across, so that even a bullet smaller than a cell
    # has a shape.
    step = min(step, 0.5 * body.radius)
    if body.length == 0.0:
        side = math.ceil(body.radius / step)
        axis = (torch.arange(-side, side, dtype=torch.float64) + 0.5) * step
        lattice = torch.cartesian_prod(axis, axis, axis)
        return lattice[lattice.norm(dim=1) <= body.radius], volume
    lattice = blue_cylinder(body.radius, body.length, step, seed)
    turn = [turned(quaternion_to(body.axis), e) for e in torch.eye(3).tolist()]
    return lattice @ torch.tensor(turn, dtype=torch.float64), volume


def _cell_order(points: Tensor, edge: float) -> Tensor:
    """Order of points [N, 3] by block of 4^3 cells, then by cell: neighbours in memory as in space.

    The transfers run several times faster on points that are stored in this order
    (docs/theory/mpm.md).
    """
    cell = torch.floor((points - points.amin(dim=0)) / edge).to(torch.int64)
    block, local = cell // 4, cell % 4
    size = block.amax(dim=0) + 1
    key = (block[:, 0] * size[1] + block[:, 1]) * size[2] + block[:, 2]
    key = ((key * 4 + local[:, 0]) * 4 + local[:, 1]) * 4 + local[:, 2]
    return torch.argsort(key, stable=True)


def _placed(body: Body, points: Tensor) -> Tensor:
    """Bring a body's own points to scene metres, before its approach is undone."""
    return body.frame.apply(points) + torch.tensor(body.offset, dtype=torch.float64)


def _parameters(
    body: Body, points: Tensor, seed: int, noise: Tensor, dx: float
) -> tuple[Tensor, Tensor, Tensor, Tensor | None]:
    """Return per-point parameters [N, 8], law [N] (int32), alpha0 [N] and viscosity [N, 9].

    The first and the third are float64; the viscosity is None where there is none.

    What has a scatter of its own that does not hang on the grid (a Weibull modulus) is spared the
    ``noise`` [N] from point to point.
    """
    count = points.shape[0]
    solid = body.solid

    def sampler(material: Material, index: Tensor) -> Callable[[materials.Field], Tensor]:
        def sample(value: materials.Field) -> Tensor:
            if not isinstance(value, Tensor) or value.ndim == 0:
                return torch.full((index.shape[0],), float(value), dtype=torch.float64)
            if solid is None or value.shape != solid.occupancy.shape:
                wanted = [] if solid is None else list(solid.occupancy.shape)
                raise InputError(
                    f"material {material.name!r}: a field must have the shape of the voxels "
                    f"{wanted}, "
                    f"got {list(value.shape)}",
                    hint="sample the field on Solid.occupancy's grid",
                )
            voxel, _ = solid.voxel_index(points[index])
            return value.to("cpu", torch.float64)[voxel[:, 0], voxel[:, 1], voxel[:, 2]]

        return sample

    params = torch.zeros(count, 8, dtype=torch.float64)
    law = torch.zeros(count, dtype=torch.int32)
    alpha = torch.zeros(count, dtype=torch.float64)
    viscous: Tensor | None = None
    everywhere = torch.ones(count, dtype=torch.bool)
    layers = [
        (body.material, everywhere),
        *((p.material(body.material), select(p, body, points)) for p in body.parts),
    ]
    for material, mask in layers:
        index = mask.nonzero()[:, 0]
        at = sampler(material, index)
        law[index] = materials.LAWS[material.law]
        if material.law == "nacc":
            factor = _weakness(material, points[index] * body.frame.scale, seed, dx)
            params[index], alpha[index] = brittle_rows(material, at, factor, dx)
            if material.weibull_modulus == 0.0:
                alpha[index] = alpha[index] * (1.0 + noise[index])
        elif material.law == "phase_field":
            factor = _weakness(material, points[index] * body.frame.scale, seed, dx)
            params[index] = materials.phase_field.rows(material, at, factor, dx)
            alpha[index] = at(material.start_alpha)
        else:
            params[index], alpha[index] = material.parameters(at), at(material.start_alpha)
        if material.viscous or viscous is not None:
            viscous = torch.zeros(count, 9) if viscous is None else viscous
            viscous[index, 6:] = material.viscosities(at).to(viscous)
    return params, law, alpha, viscous


def _weakness(material: Material, points: Tensor, seed: int, dx: float) -> Tensor:
    """Smooth random factor on strength at points in the body's own coordinates [m], [N].

    A sum of plane waves with random directions and phases is a Gaussian random field of unit
    variance and correlation length ``grain``; it is fixed in object space. With a Weibull modulus m
    the strength of a volume V is ``(V_ref ln U / (V ln 1/2))^(1/m)`` of the median one of a volume
    V_ref (Weibull 1939), U uniform: here the field's own probability, V a grain or, where the grid
    is coarser, eight cells - so that the weakest place of a body is as weak on every grid.
    """
    modulus = material.weibull_modulus
    if material.variation == 0.0 and modulus == 0.0:
        return torch.ones(points.shape[0], dtype=torch.float64)
    grain = max(material.grain, 2.0 * dx) if modulus else material.grain
    generator = torch.Generator().manual_seed(seed + 104729)
    waves = torch.randn(_WAVES, 3, generator=generator, dtype=torch.float64)
    phases = torch.rand(_WAVES, generator=generator, dtype=torch.float64) * (2.0 * math.pi)
    angle = points @ (waves / grain).T + phases
    field = torch.cos(angle).sum(dim=1) * math.sqrt(2.0 / _WAVES)
    if modulus:
        survives = torch.special.log_ndtr(-field) / math.log(0.5)  # ln U / ln 1/2
        return (material.reference_volume / grain**3 * survives) ** (1.0 / modulus)
    return (1.0 + material.variation * field.clamp(-2.0, 2.0)).clamp(min=0.05)


def select(part: Part, body: Body, points: Tensor) -> Tensor:
    """Tell which of a body's points (own coordinates, [N, 3]) belong to a part, bool [N].

    Raises:
        InputError: The condition needs colours or regions that the solid does not have.
    """
    solid = body.solid
    if solid is None:
        raise InputError(
            f"part {part.name!r}: a ball has no parts", hint="give the parts to a solid"
        )
    where = part.where
    mask = torch.ones(points.shape[0], dtype=torch.bool)
    on_device = points.to(solid.occupancy.device)
    if "depth_below" in where or "depth_above" in where:
        depth = solid.depth_at(on_device).cpu() * body.frame.scale
        # "below 12 mm" means the layer from the surface down to 12 mm.
        mask &= depth < float(where.get("depth_below", math.inf))
        mask &= depth >= float(where.get("depth_above", -math.inf))
    if "color_near" in where:
        if solid.color is None:
            raise InputError(
                f"part {part.name!r}: 'color_near' needs a textured solid",
                hint="run the texture stage first",
            )
        wanted = torch.tensor(where["color_near"], dtype=torch.float64)
        color = solid.color_at(on_device).cpu().to(torch.float64)
        mask &= (color - wanted).norm(dim=1) <= float(where.get("tolerance", 0.15))
    if any(name in where for name in (*SOURCES, "label")):
        chosen = torch.from_numpy(region_mask(solid, where, part.name))
        voxel = solid.voxel_index(on_device)[0].cpu()
        mask &= chosen[voxel[:, 0], voxel[:, 1], voxel[:, 2]]
    if "region" in where:
        if solid.regions is None:
            raise InputError(
                f"part {part.name!r}: the solid has no regions",
                hint="use depth_below or color_near",
            )
        voxel, _ = solid.voxel_index(on_device)
        mask &= (solid.regions[voxel[:, 0], voxel[:, 1], voxel[:, 2]] == int(where["region"])).cpu()
    at = body.frame.apply(points)
    if "box" in where:
        low, high = torch.tensor(where["box"], dtype=torch.float64)
        mask &= ((at >= low) & (at <= high)).all(dim=1)
    if "sphere" in where:
        x, y, z, radius = (float(value) for value in where["sphere"])
        mask &= (at - torch.tensor([x, y, z], dtype=torch.float64)).norm(dim=1) <= radius
    return mask


def _approach(body: Body, scene: Scene) -> tuple[Tensor, Tensor]:
    """Shift and velocity at time 0 so that free flight passes ``offset`` at ``start``."""
    if body.held:
        return torch.zeros(3, dtype=torch.float64), torch.tensor(body.velocity, dtype=torch.float64)
    gravity = torch.tensor(scene.gravity, dtype=torch.float64)
    velocity = torch.tensor(body.velocity, dtype=torch.float64) - gravity * body.start
    shift = -(velocity * body.start + 0.5 * gravity * body.start**2)
    return shift, velocity


def start_of(
    body: Body, scene: Scene, points: Tensor, mass: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Where points of a body's own coordinates are at time 0, and how they move.

    Args:
        body: The body.
        scene: Its scene, for gravity.
        points: Float64 [N, 3].
        mass: [kg], [N].

    Returns:
        Position [N, 3], velocity [N, 3] and velocity gradient [3, 3], in scene metres.
    """
    return _start(body, scene, _placed(body, points), mass)


def _start(body: Body, scene: Scene, placed: Tensor, mass: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return position [N, 3], velocity [N, 3] and velocity gradient [3, 3] at time 0."""
    shift, velocity = _approach(body, scene)
    center = (mass[:, None] * placed).sum(dim=0) / mass.sum()
    wx, wy, wz = body.angular_velocity
    spin = torch.tensor([[0.0, -wz, wy], [wz, 0.0, -wx], [-wy, wx, 0.0]], dtype=torch.float64)
    return placed + shift, velocity + (placed - center) @ spin.T, spin
