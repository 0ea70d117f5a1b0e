"""Train gsplat's default recipe on a capture, as a program beside gsfluent; prints one JSON line.

python scripts/bench/gsplat/train.py CAPTURE [--iterations 7000] [--image-size 800] [--device cuda]

gsplat must be installed; none of its code is part of gsfluent. What is used of it is
``rasterization`` and ``DefaultStrategy``; the values are those of its examples/simple_trainer.py,
default configuration, with that number of steps: learning rates 1.6e-4 times the scene's size,
falling to 1 % (means), 5e-3 (scales), 1e-3 (rotations), 5e-2 (opacities), 2.5e-3 (SH constant) and
a twentieth of it (SH rest); Adam with eps 1e-15; one more SH degree every 1000 steps up to 3; loss
0.8 L1 + 0.2 (1 - SSIM over the windows inside the image); one photograph a step; start at the
sparse points, opacity 0.1, scale the mean distance of three neighbours; unpacked, classic.

Favours to gsplat: photographs stay on the device (its loader copies them), the loss is not read
back each step, SSIM is gsfluent's. Two things differ because its loader knows only COLMAP scenes: a
capture with masks is trained and judged before white, and one without sparse points starts from
10,000 coloured points on the visual hull that gsfluent starts from (its loader's other start,
100,000 random points, is not measured here).

The photographs, the held-out ones (every eighth) and the judging are gsfluent's own:
``gsfluent.pipeline.reconstruct.evaluate.evaluate``; ``psnr_own`` is the same through gsplat's
renderer. ``seconds`` is training alone, ``total_seconds`` with reading and judging.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

import gsfluent as gf
from gsfluent.data import Capture, Gaussians
from gsfluent.errors import GsfluentError, InputError
from gsfluent.io import save_splats
from gsfluent.metrics import psnr, ssim
from gsfluent.pipeline.capture.hull import focus_point, visual_hull
from gsfluent.pipeline.capture.views import read_views
from gsfluent.pipeline.reconstruct.evaluate import HOLD_OUT, evaluate
from gsfluent.pipeline.reconstruct.init import hull_gaussians

SH_C0 = 0.28209479177387814
RATES = {
    "means": 1.6e-4, "scales": 5e-3, "quats": 1e-3, "opacities": 5e-2, "sh0": 2.5e-3,
    "shN": 2.5e-3 / 20,
}  # fmt: skip
SSIM_SHARE, FINAL_RATE = 0.2, 0.01
SH_EVERY, SH_DEGREE = 1000, 3
START_OPACITY, HULL_POINTS = 0.1, 10_000
NEAR, FAR = 0.01, 1e10


@dataclass(frozen=True)
class Photograph:
    """One training view on the device, in the normalised frame."""

    color: Tensor
    valid: Tensor | None
    viewmat: Tensor
    K: Tensor


@dataclass(frozen=True)
class Frame:
    """Where gsplat trains: ``normalised = (world - center) * scale``."""

    center: Tensor
    scale: float
    scene_scale: float

    @staticmethod
    def of(capture: Capture) -> Frame:
        """Cameras at a median distance of 1 from the point they look at; size 1.1 times the
        largest distance of a camera from their mean."""
        viewmats = torch.stack([camera.viewmat for camera in capture.cameras]).double()
        eyes = capture.centers().double()
        center = focus_point(viewmats).cpu()
        scale = 1.0 / float((eyes - center).norm(dim=1).median().clamp_min(1e-12))
        size = scale * float((eyes - eyes.mean(0)).norm(dim=1).max())
        return Frame(center, scale, 1.1 * size)

    def viewmat(self, world: Tensor) -> Tensor:
        """World-to-camera matrix for points of this frame."""
        view = world.double().clone()
        view[:3, 3] = (view[:3, :3] @ self.center + view[:3, 3]) * self.scale
        return view.float()

    def world(self, splats: dict[str, Tensor]) -> Gaussians:
        """The splats back in the capture's frame, activated."""
        return Gaussians(
            means=splats["means"].detach() / self.scale + self.center.to(splats["means"]),
            quats=torch.nn.functional.normalize(splats["quats"].detach(), dim=-1),
            scales=splats["scales"].detach().exp() / self.scale,
            opacities=splats["opacities"].detach().sigmoid(),
            sh=torch.cat([splats["sh0"], splats["shN"]], 1).detach(),
        )


def photographs(
    capture: Capture, frame: Frame, size: int, device: torch.device
) -> tuple[list[Photograph], Tensor | None]:
    """Every photograph, and the background (white with masks, else none)."""
    found, white = [], None
    for index in range(len(capture)):
        view = capture.view(index, size)
        color, valid = view.image, view.valid
        if view.mask is not None:
            mask = view.mask[..., None]
            color, white = color * mask + (1.0 - mask), torch.ones(1, 3, device=device)
        found.append(
            Photograph(
                color.to(device).contiguous(),
                None if valid is None else valid.to(device),
                frame.viewmat(view.camera.viewmat)[None].to(device),
                view.camera.K.float()[None].to(device),
            )
        )
    return found, white


def hull_points(capture: Capture, size: int, seed: int) -> tuple[Tensor, Tensor]:
    """Points on the visual hull of the masks and their colours, [P, 3] each, world frame."""
    views = read_views(capture, size, torch.device("cpu"), crop=True)
    g = torch.Generator().manual_seed(seed)
    found = hull_gaussians(visual_hull(views), views, HULL_POINTS, 0, g)
    return found.means.double(), found.colors()


def start(capture: Capture, frame: Frame, size: int, seed: int) -> dict[str, Tensor]:
    """The first splats: at the sparse points, or on the visual hull where there are none.

    Raises:
        InputError: The capture has neither points nor masks.
    """
    from scipy.spatial import cKDTree

    g = torch.Generator().manual_seed(seed)
    points, colors = capture.points.double(), capture.point_colors.float()
    if points.shape[0] < 4:
        if capture.view(0, size).mask is None:
            raise InputError(
                f"{capture.root}: no sparse points and no masks to start from", "give either"
            )
        points, colors = hull_points(capture, size, seed)
    points = ((points - frame.center) * frame.scale).float()
    near, _ = cKDTree(points.numpy()).query(points.numpy(), k=4)
    distance = torch.from_numpy(near[:, 1:]).square().mean(1).sqrt().float().clamp_min(1e-7)
    count = points.shape[0]
    sh = torch.zeros(count, (SH_DEGREE + 1) ** 2, 3)
    sh[:, 0] = (colors - 0.5) / SH_C0
    values = {
        "means": points,
        "scales": distance.log()[:, None].repeat(1, 3),
        "quats": torch.rand(count, 4, generator=g),
        "opacities": torch.full((count,), math.log(START_OPACITY / (1.0 - START_OPACITY))),
        "sh0": sh[:, :1].contiguous(),
        "shN": sh[:, 1:].contiguous(),
    }
    return values


def draw(
    splats: Any, viewmat: Tensor, K: Tensor, size: tuple[int, int], degree: int, back: Tensor | None
) -> tuple[Tensor, dict[str, Any]]:
    """gsplat's image [H, W, 3] and what its strategy wants to know."""
    from gsplat import rasterization

    image, _, info = rasterization(
        splats["means"], splats["quats"], splats["scales"].exp(), splats["opacities"].sigmoid(),
        torch.cat([splats["sh0"], splats["shN"]], 1), viewmat, K, *size, near_plane=NEAR,
        far_plane=FAR, sh_degree=degree, packed=False, backgrounds=back,
    )  # fmt: skip
    return image[0], info


def train(
    first: dict[str, Tensor],
    views: list[Photograph],
    white: Tensor | None,
    frame: Frame,
    iterations: int,
    seed: int,
) -> dict[str, Tensor]:
    """The loop of gsplat's simple_trainer."""
    from gsplat import DefaultStrategy

    splats = torch.nn.ParameterDict({k: torch.nn.Parameter(v) for k, v in first.items()})
    rates = RATES | {"means": RATES["means"] * frame.scene_scale}
    fused = first["means"].is_cuda
    optimizers = {
        name: torch.optim.Adam(
            [{"params": splats[name], "lr": rate, "name": name}], eps=1e-15, fused=fused
        )
        for name, rate in rates.items()
    }
    falling = torch.optim.lr_scheduler.ExponentialLR(
        optimizers["means"], gamma=FINAL_RATE ** (1.0 / iterations)
    )
    strategy = DefaultStrategy()
    strategy.check_sanity(splats, optimizers)
    state = strategy.initialize_state(scene_scale=frame.scene_scale)
    g = torch.Generator().manual_seed(seed)
    order: list[int] = []
    for step in range(iterations):
        order = order or torch.randperm(len(views), generator=g).tolist()
        view = views[order.pop()]
        size = (view.color.shape[1], view.color.shape[0])
        degree = min(step // SH_EVERY, SH_DEGREE)
        image, info = draw(splats, view.viewmat, view.K, size, degree, white)
        strategy.step_pre_backward(splats, optimizers, state, step, info)
        loss = loss_of(image, view)
        loss.backward()
        for optimizer in optimizers.values():
            optimizer.step()
            optimizer.zero_grad(set_to_none=True)
        falling.step()
        strategy.step_post_backward(splats, optimizers, state, step, info, packed=False)
    return {name: value.detach() for name, value in splats.items()}


def loss_of(image: Tensor, view: Photograph) -> Tensor:
    """0.8 L1 + 0.2 (1 - SSIM); pixels that no photograph covers count in neither."""
    target = view.color
    if view.valid is not None:
        flat = (image - target)[view.valid]
        image, target = image * view.valid[..., None], target * view.valid[..., None]
    else:
        flat = image - target
    return (1.0 - SSIM_SHARE) * flat.abs().mean() + SSIM_SHARE * (1.0 - ssim(image, target))


@torch.no_grad()
def own_psnr(splats: dict[str, Tensor], frame: Frame, held: Capture, size: int) -> float:
    """Held-out PSNR [dB] through gsplat's renderer, otherwise as ``evaluate``."""
    views, white = photographs(held, frame, size, splats["means"].device)
    values = []
    for view in views:
        shape = (view.color.shape[1], view.color.shape[0])
        image, _ = draw(splats, view.viewmat, view.K, shape, SH_DEGREE, white)
        weight = None if view.valid is None else view.valid.float()
        values.append(psnr(image.clamp(0.0, 1.0), view.color, weight))
    return sum(values) / len(values)


def reconstruct(
    capture: Capture, iterations: int, image_size: int, device: torch.device, seed: int = 0
) -> tuple[Gaussians, dict[str, Any]]:
    """Train gsplat on a capture: Gaussians in the capture's frame, and the report."""
    torch.manual_seed(seed)
    began = time.monotonic()
    train_set, held = capture.split(HOLD_OUT)
    frame = Frame.of(train_set)
    views, white = photographs(train_set, frame, image_size, device)
    loop = time.monotonic()
    first = {
        name: value.to(device) for name, value in start(train_set, frame, image_size, seed).items()
    }
    splats = train(first, views, white, frame, iterations, seed)
    if device.type == "cuda":
        torch.cuda.synchronize()
    trained = time.monotonic()
    gaussians = frame.world(splats)
    judged = evaluate(gaussians, held, image_size)
    done = time.monotonic()
    report = {
        "capture": capture.root.name,
        "trainer": "gsplat",
        "iterations": iterations,
        "gaussians": gaussians.count,
        "psnr": judged["psnr"],
        "ssim": judged["ssim"],
        "seconds": round(trained - loop, 2),
        "image_size": image_size,
        "held_out": 0 if held is None else len(held),
        "total_seconds": round(done - began, 2),
        "psnr_own": None if held is None else round(own_psnr(splats, frame, held, image_size), 3),
        "start": first["means"].shape[0],
    }
    return gaussians, report


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("capture", type=Path)
    parser.add_argument("--iterations", type=int, default=7000)
    parser.add_argument("--image-size", type=int, default=800)
    parser.add_argument("--device", default="cuda")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, help="write the splats here (.ply)")
    options = parser.parse_args(arguments)
    if options.iterations < 1 or options.image_size < 24:
        parser.error("--iterations must be at least 1 and --image-size at least 24")
    try:
        import gsplat  # noqa: F401
    except ImportError:
        parser.error("gsplat is not installed; docs/measured/benchmarks.md names the version")
    device = torch.device(options.device)
    try:
        capture = gf.load_capture(options.capture)
        gaussians, report = reconstruct(
            capture, options.iterations, options.image_size, device, options.seed
        )
        if options.out is not None:
            save_splats(gaussians.to("cpu"), options.out)
    except GsfluentError as error:
        sys.stderr.write(f"error: {error}\n")
        return 1
    sys.stdout.write(json.dumps(report) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
