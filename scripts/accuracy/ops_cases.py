"""The workloads of ops.py: every op on what the melon demo gives it, drawn once in float32."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor

from gsfluent import materials, ops
from gsfluent.ops.reference import adam, deform, losses, mpm, mvee, plasticity, raster

DX = 0.0128  # the demo's node spacing [m]
DT = 1e-4
BOTH = (torch.float32, torch.float64)
CUT = "1/255 cut, early stop or depth order within rounding"
ROOT = "yield or root selection within rounding"
TOUCH = "contact touch or collider side within rounding"
Results = dict[str, Tensor]


@dataclass(frozen=True)
class Case:
    """One op on one workload.

    ``call(op, inputs)`` runs ``op`` (gsfluent.ops or its reference module) on the inputs in any
    precision. Without a reference the truth is the op itself in float64. ``jumps`` names the
    decision by which results may jump; empty means that no entry is ever excused.
    """

    name: str
    inputs: dict[str, Any]
    call: Callable[[Any, dict[str, Any]], Results]
    reference: Any = None
    jumps: str = ""
    bars: dict[torch.dtype, float] = field(default_factory=dict)
    note: str = ""  # why the bars are wider than the ordinary ones


def uniform(seed: int, *shape: int, low: float = 0.0, high: float = 1.0) -> Tensor:
    return torch.rand(shape, generator=torch.Generator().manual_seed(seed)) * (high - low) + low


def normal(seed: int, *shape: int) -> Tensor:
    return torch.randn(shape, generator=torch.Generator().manual_seed(seed))


def gradients(outputs: list[Tensor], cotangents: list[Tensor], wrt: Results) -> Results:
    """Gradients of the outputs' sum weighted by fixed numbers."""
    loss = sum(((o * c).sum() for o, c in zip(outputs, cotangents, strict=True)), outputs[0].sum())
    found = torch.autograd.grad(loss, list(wrt.values()))
    return {f"d/d {name}": g for name, g in zip(wrt, found, strict=True)}


def leaves(inputs: dict[str, Any], *names: str) -> Results:
    return {n: inputs[n].detach().clone().requires_grad_() for n in names}


def melon(count: int) -> dict[str, Any]:
    """Two halves of a ball, eight particles per cell, meeting at 1 to 4 m/s above the floor."""
    radius = (3.0 * count / (4.0 * math.pi * 8.0)) ** (1.0 / 3.0) * DX
    direction = torch.nn.functional.normalize(normal(0, count, 3), dim=1)
    position = direction * radius * uniform(1, count, 1) ** (1.0 / 3.0)
    position[:, 2] += 0.9 * radius
    body = (position[:, 0] > 0).int()
    velocity = uniform(2, count, 3, low=-0.5, high=0.5) + torch.tensor([0.0, 0.0, -4.0])
    velocity[:, 0] += 1.0 - 2.0 * body
    return {
        "position": position,
        "velocity": velocity,
        "affine": normal(3, count, 3, 3) * 20.0,
        "mass": torch.full((count,), 950.0 * DX**3 / 8.0) * uniform(4, count, low=0.8, high=1.2),
        "stress": normal(5, count, 6) * 5e3,
        "volume": torch.full((count,), DX**3 / 8.0),
        "body": body,
        "blocks": ops.build_blocks(position, DX),
    }


def _p2g(op: Any, p: dict[str, Any]) -> Results:
    wrt = leaves(p, "velocity", "affine", "mass", "stress", "volume")
    options = {k: wrt[k] for k in ("stress", "volume")}
    args = [wrt[k] for k in ("velocity", "affine", "mass")]
    grid, _ = op.p2g(p["position"], *args, dx=DX, dt=DT, blocks=p["blocks"], **options)
    found = gradients([grid], [p["seed_grid"]], wrt)
    return {"momentum": grid[..., :3].detach(), "mass": grid[..., 3].detach(), **found}


def _p2g_contact(op: Any, p: dict[str, Any]) -> Results:
    args = [p[k] for k in ("position", "velocity", "affine", "mass")]
    options = {k: p[k] for k in ("stress", "volume", "body", "blocks")}
    grid, moments = op.p2g(*args, dx=DX, dt=DT, fields=2, contact=True, **options)
    return {"momentum": grid[..., :3], "first moment": moments}


def _grid_update(op: Any, p: dict[str, Any]) -> Results:
    options = {k: p[k] for k in ("blocks", "colliders", "moments")}
    velocity, impulse, *_, touched = op.grid_update(p["grid"], dx=DX, dt=DT, **options)
    return {"velocity": velocity, "impulse": impulse, "contact nodes": touched.double()}


def _g2p(op: Any, p: dict[str, Any]) -> Results:
    wrt = leaves(p, "velocity_grid", "deformation")
    field_, rest = wrt["velocity_grid"], wrt["deformation"]
    options = {"dx": DX, "dt": DT, "blocks": p["blocks"], "body": p["body"]}
    x, v, c, f = op.g2p(field_, p["position"], deformation=rest, **options)[:4]
    found = gradients([v, c, f], [p["seed_v"], p["seed_c"], p["seed_f"]], wrt)
    values = {"position": x, "velocity": v, "affine": c, "deformation": f}
    return {**{k: t.detach() for k, t in values.items()}, **found}


def mpm_cases(count: int) -> Iterator[Case]:
    p = melon(count)
    nodes = p["blocks"].block_count
    yield Case("p2g", {**p, "seed_grid": normal(6, 1, nodes, 64, 4)}, _p2g, mpm)
    yield Case("p2g, contact moments", p, _p2g_contact, mpm)
    args = [p[k] for k in ("position", "velocity", "affine", "mass")]
    # The node's own grid, as float32 made it: errors of p2g are not counted twice.
    grid, moments = ops.p2g(
        *args, dx=DX, blocks=p["blocks"], body=p["body"], fields=2, contact=True
    )
    plane = [0, 2, 0.4, 0, 0, 0.001, 0, 0, 1, 0, 0, 0, 0, 0.1, 0, 0]
    ball = [1, 1, 0, 0.02, 0, 0.05, 0, 0, 0, 0.03, 0.5, 0, 0, 0, 0, 0]
    given = {"grid": grid, "moments": moments, "colliders": torch.tensor([plane, ball]).float()}
    given["blocks"] = p["blocks"]
    yield Case("grid_update, contact and colliders", given, _grid_update, mpm, TOUCH)
    g = {k: p[k] for k in ("position", "body", "blocks")}
    g["velocity_grid"] = ops.grid_update(dx=DX, dt=DT, **given)[0]
    g["deformation"] = torch.eye(3) + 0.1 * normal(7, count, 3, 3)
    g |= {"seed_v": normal(8, count, 3), "seed_c": DX * normal(9, count, 3, 3)}
    yield Case("g2p", {**g, "seed_f": normal(10, count, 3, 3)}, _g2p, mpm)


def _return_mapping(op: Any, p: dict[str, Any]) -> Results:
    args = [p[k] for k in ("strain", "alpha", "increment")]
    options = {k: p[k] for k in ("law", "params", "material")}
    strain, alpha, stress, _ = op.return_mapping(*args, **options, dt=DT)
    return {"strain": strain, "alpha": alpha, "stress": stress}


def material_cases(count: int) -> Iterator[Case]:
    flesh = materials.get("fruit.watermelon")
    rind = {k: v for k, v in flesh.parts[0].items() if k not in ("name", "where")}
    brittle = flesh.override(cohesion=0.6, hardening=3.0, shear_damage=0.0)
    table = [m.parameters() for m in (flesh, flesh.override(**rind), brittle)]
    params = torch.stack(table).float()
    loose = {
        "strain": uniform(11, count, 6, low=-0.1, high=0.1),
        "alpha": -0.105 * (1.0 + 0.35 * normal(12, count)),
        "law": torch.ones(3, dtype=torch.int32),
        "params": params,
        "material": (torch.arange(count) % 2).int(),
    }
    loose["increment"] = torch.zeros(count, 3, 3)
    # Particles start on their yield surface or inside; the step takes them beyond.
    settled = _return_mapping(ops, loose)
    start = {**loose, "strain": settled["strain"], "alpha": settled["alpha"]}
    soft = {**start, "increment": 0.004 * normal(13, count, 3, 3)}
    elastic = {**soft, "law": torch.zeros(3, dtype=torch.int32)}
    hard = {
        **loose,
        "increment": 0.02 * normal(14, count, 3, 3),
        "alpha": -0.08 * uniform(15, count),
    }
    hard["material"] = torch.full((count,), 2, dtype=torch.int32)
    yield Case("return_mapping, elastic", elastic, _return_mapping, plasticity)
    yield Case("return_mapping, nacc", soft, _return_mapping, plasticity, ROOT)
    yield Case("return_mapping, nacc, violent step", hard, _return_mapping, plasticity, ROOT)
    for name in ("sand", "plasticine", "honey"):
        preset = materials.get(name)
        flowing = {
            "strain": uniform(18, count, 6, low=-0.05, high=0.03),
            "alpha": 0.01 * uniform(19, count),
            "increment": 0.01 * normal(20, count, 3, 3),
            "law": torch.tensor([materials.LAWS[preset.law]], dtype=torch.int32),
            "params": preset.parameters()[None].float(),
            "material": torch.zeros(count, dtype=torch.int32),
        }
        yield Case(f"return_mapping, {preset.law}", flowing, _return_mapping, plasticity, ROOT)
    turn = torch.linalg.qr(normal(16, 2, count, 3, 3))[0]
    turn *= torch.linalg.det(turn).sign()[..., None, None]
    stretch = torch.diag_embed(uniform(17, count, 3, low=0.2, high=2.5))

    def polar(op: Any, p: dict[str, Any]) -> Results:
        return dict(zip(("rotation", "clamped"), op.polar_clamped(p["F"]), strict=True))

    yield Case("polar_clamped", {"F": turn[0] @ stretch @ turn[1]}, polar, deform)


def _mvee(op: Any, p: dict[str, Any]) -> Results:
    """Centre and shape at the last gap float64 resolves; in float32 the volume, which the same
    rounding moves by its square only."""
    if op is mvee:
        center, shape = op.mvee(p["points"], tolerance=1e-7, max_iterations=5000)
    else:
        center, shape = op.mvee(p["points"], tolerance=1e-12)
    return {"center": center, "shape": shape}


def _mvee_volume(op: Any, p: dict[str, Any]) -> Results:
    """Volume at the default tolerance against the smallest."""
    if op is mvee:
        shape = mvee.mvee(p["points"], tolerance=1e-4)[1]
    else:
        shape = op.mvee(p["points"])[1]
    return {"volume": torch.linalg.det(shape.double()).sqrt()}


def _mvee_inside(op: Any, p: dict[str, Any]) -> Results:
    if op is mvee:
        return {"farthest point": torch.ones(p["points"].shape[0], dtype=torch.float64)}
    center, shape = (t.double() for t in op.mvee(p["points"]))
    offset = p["points"].to(shape) - center[:, None]
    reach = (offset @ torch.linalg.inv(shape) * offset).sum(2).amax(1)
    return {"farthest point": reach}


def _lens(op: Any, p: dict[str, Any]) -> Results:
    args = [p[k] for k in ("mean_a", "cov_a", "mean_b", "cov_b")]
    mean, cov, overlap = op.mvee_lens(*args)
    return {"mean": mean, "covariance": cov, "overlap": overlap.double()}


def _lens_volume(op: Any, p: dict[str, Any]) -> Results:
    cov = _lens(op, p)["covariance"].double()
    return {"volume": torch.linalg.det(cov).clamp(min=0.0).sqrt()}


def mvee_cases(count: int) -> Iterator[Case]:
    cloud = {"points": uniform(18, count, 32, 3)}
    bars = {torch.float32: 3e-2, torch.float64: 1e-3}
    note = "a shape is known to the root of the volume's gap"
    yield Case("mvee, last gap", cloud, _mvee, mvee, bars=bars, note=note)
    bars, note = dict.fromkeys(BOTH, 1e-3), "the default gap, doubled"
    yield Case("mvee, default gap", cloud, _mvee_volume, mvee, bars=bars, note=note)
    bars, note = {torch.float32: 1e-5, torch.float64: 1e-8}, "the margin it adds on purpose"
    yield Case("mvee, points at most on it", cloud, _mvee_inside, mvee, bars=bars, note=note)
    frame = torch.linalg.qr(normal(19, 2, count, 3, 3))[0]
    size = uniform(20, 2, count, 3, low=0.003, high=0.008)
    cov = frame * size[..., None, :] ** 2 @ frame.mT
    pair = {"mean_a": uniform(21, count, 3), "cov_a": cov[0]}
    pair["mean_b"] = pair["mean_a"] + 0.005 * normal(22, count, 3)
    same, other = {**pair, "cov_b": cov[0].clone()}, {**pair, "cov_b": cov[1]}
    bars, note = {torch.float32: 1e-4}, "widened by what rounding of the centre takes away"
    yield Case("mvee_lens, same shape (closed form)", same, _lens, bars=bars, note=note)
    note = "a shape is known to the root of the volume's gap"
    bars = dict.fromkeys(BOTH, 5e-2)
    yield Case("mvee_lens, any shapes (fitted)", other, _lens, bars=bars, note=note)
    note, bars = "the reference samples 600 points", dict.fromkeys(BOTH, 4e-2)
    yield Case("mvee_lens, same shape, sampled", same, _lens_volume, mvee, bars=bars, note=note)
    yield Case("mvee_lens, any shapes, sampled", other, _lens_volume, mvee, bars=bars, note=note)


def _rasterize(op: Any, p: dict[str, Any]) -> Results:
    names = ("means", "opacities", "quats", "scales", "sh", "normals", "background")
    wrt = leaves(p, *names, "means2d_offset")
    rest = {k: v for k, v in wrt.items() if k not in names[:2]}
    args = (wrt["means"], wrt["opacities"], p["viewmat"], p["K"])
    height, width = p["seed_alpha"].shape
    got = op.rasterize(*args, width, height, **rest)[:4]
    labels = ("image", "alpha", "depth", "normal")
    found = gradients(list(got), [p[f"seed_{k}"] for k in labels], wrt)
    return {**{k: t.detach() for k, t in zip(labels, got, strict=True)}, **found}


def splats(count: int, width: int, height: int, focal: float, x: float, y: float) -> dict[str, Any]:
    """A shell of flat splats 0.26 m across, 0.6 m away; (x, y) is the principal point [px]."""
    outward = torch.nn.functional.normalize(normal(23, count, 3), dim=1)
    spacing = 0.13 * math.sqrt(4.0 * math.pi / count)
    means = 0.13 * outward * uniform(24, count, 1, low=0.97, high=1.0)
    viewmat = torch.eye(4)
    viewmat[2, 3] = 0.6
    return {
        "means": means,
        "opacities": uniform(25, count, low=0.05, high=0.99),
        "quats": normal(26, count, 4),
        "scales": spacing * uniform(27, count, 3, low=0.2, high=1.0),
        "sh": 0.2 * normal(28, count, 16, 3),
        "normals": outward,
        "background": torch.ones(3),
        "means2d_offset": torch.zeros(count, 2),
        "viewmat": viewmat,
        "K": torch.tensor([[focal, 0, x], [0, focal, y], [0, 0, 1.0]]),
        "seed_image": normal(29, height, width, 3),
        "seed_alpha": normal(30, height, width),
        "seed_depth": normal(31, height, width),
        "seed_normal": normal(32, height, width, 3),
    }


def raster_cases(count: int) -> Iterator[Case]:
    scale = math.sqrt(count / 60_000)  # of the image: the same splats per pixel at every size
    width, height, focal = int(640 * scale), int(480 * scale), 800 * scale
    whole = splats(count, width, height, focal, width / 2, height / 2)
    # A window on the silhouette, with the splats that reach it: what the reference can afford.
    window = splats(count, 40, 30, focal, 20 - 150 * scale, 15 - 60 * scale)
    args = [window[k] for k in ("means", "opacities", "viewmat", "K")]
    shape = {k: window[k] for k in ("quats", "scales", "sh")}
    seen = ops.rasterize(*args, 40, 30, **shape).radii > 0
    for name, value in window.items():
        if value.shape[:1] == (count,):
            window[name] = value[seen]
    yield Case(f"rasterize, window, {int(seen.sum())} splats", window, _rasterize, raster, CUT)
    yield Case(f"rasterize, {width}x{height}, {count} splats", whole, _rasterize, None, CUT)


def _photometric(op: Any, p: dict[str, Any]) -> Results:
    wrt = leaves(p, "image", "alpha")
    fixed = {k: p[k] for k in ("valid", "mask", "backdrop")}
    got = op.photometric_loss(
        wrt["image"], p["target"], alpha=wrt["alpha"], mask_weight=2.0, **fixed
    )
    found = gradients([got[0]], [p["seed"]], wrt)
    labels = ("loss", "|miss|", "similarity", "miss^2", "|excess|")
    return {**{k: t.detach() for k, t in zip(labels, got, strict=True)}, **found}


def _ssim_map(op: Any, p: dict[str, Any]) -> Results:
    wrt = leaves(p, "image", "target")
    got = op.ssim(*wrt.values(), padding="same", reduction="none")
    return {"map": got.detach(), **gradients([got], [p["seed_map"]], wrt)}


def _adam(op: Any, p: dict[str, Any]) -> Results:
    """One step; the reference returns what the op changes in place."""
    state = [p[k].clone() for k in ("value", "gradient", "first", "second")]
    given = {"lr": 1e-2, "step": 7, "betas": (0.9, 0.99), "eps": 1e-15, "visible": p["visible"]}
    if op is adam:
        value, first, second = adam.adam_step(*state, **given)
    else:
        op.adam_step(*([t] for t in state), **given)
        value, _, first, second = state
    return {"moved": value - p["value"], "first": first, "second": second}


def loss_cases(count: int) -> Iterator[Case]:
    side = max(int(math.sqrt(count)), 24)
    image = uniform(33, side, side + 7, 3)
    plane = image.shape[:2]
    pictures = {
        "image": image,
        "target": 0.8 * image + 0.2 * uniform(34, *image.shape),
        "valid": uniform(35, *plane),
        "alpha": uniform(36, *plane),
        "mask": uniform(37, *plane).round(),
        "backdrop": uniform(38, 3),
        "seed": torch.ones(()),
        "seed_map": normal(39, *image.shape),
    }
    yield Case("ssim, zeros around", pictures, _ssim_map, losses)
    yield Case("photometric_loss", pictures, _photometric, losses)
    rows = {k: normal(40 + i, count, 15, 3) for i, k in enumerate(("value", "gradient", "first"))}
    rows["second"] = uniform(43, count, 15, 3)
    rows["visible"] = (uniform(44, count) > 0.3).int()
    yield Case("adam_step", rows, _adam, adam)
