"""Gaussians, Camera, Capture, Frame, Particles, Solid."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from gsfluent import geometry
from gsfluent.data import INTERIOR, SURFACE, Camera, Capture, Frame, Gaussians, Particles, Solid
from gsfluent.errors import InputError
from gsfluent.io.solid import load_solid, save_solid


def make_gaussians(count: int = 20, degree: int = 3, **extra: object) -> Gaussians:
    return Gaussians(
        torch.randn(count, 3, dtype=torch.float64),
        torch.randn(count, 4, dtype=torch.float64),
        torch.rand(count, 3, dtype=torch.float64) + 0.1,
        torch.rand(count, dtype=torch.float64),
        torch.randn(count, (degree + 1) ** 2, 3, dtype=torch.float64),
        **extra,  # type: ignore[arg-type]
    )


def make_frame() -> Frame:
    rotation = geometry.quaternion_to_matrix(torch.randn(4, dtype=torch.float64))
    return Frame(rotation, torch.randn(3, dtype=torch.float64), 2.5)


def make_solid() -> Solid:
    occupancy = torch.zeros(4, 5, 6, dtype=torch.bool)
    occupancy[1:3, 1:4, 2:5] = True
    labels = torch.full((20,), SURFACE, dtype=torch.int32)
    return Solid(
        make_gaussians(labels=labels).to(dtype=torch.float32),
        occupancy,
        torch.rand(4, 5, 6) * occupancy,
        torch.tensor([-1.0, 0.5, 2.0]),
        0.25,
        color=torch.rand(4, 5, 6, 3),
        regions=torch.ones(4, 5, 6, dtype=torch.int32),
        report={"leaks": 0, "volume": 1.5},
        frame=make_frame(),
    )


# Gaussians


def test_wrong_shape_names_field_and_source() -> None:
    good = make_gaussians()
    with pytest.raises(
        ValueError,
        match=r"quats must have shape \[N, 4\] with N = 20 \(from means\), got \[19, 4\]",
    ):
        good.replace(quats=good.quats[:19])


def test_wrong_dtype_and_type_are_type_errors() -> None:
    good = make_gaussians()
    with pytest.raises(TypeError, match="means must be float32 or float64, got int64"):
        good.replace(means=good.means.long())
    with pytest.raises(TypeError, match=r"means must be a torch\.Tensor, got list"):
        good.replace(means=[[0.0, 0.0, 0.0]])
    with pytest.raises(TypeError, match=r"opacities must be torch\.float64 like means"):
        good.replace(opacities=good.opacities.float())
    with pytest.raises(TypeError, match="labels must be int32, got int64"):
        good.replace(labels=torch.zeros(20, dtype=torch.int64))


def test_sh_must_have_a_square_number_of_coefficients() -> None:
    good = make_gaussians()
    with pytest.raises(ValueError, match="coefficient count"):
        good.replace(sh=good.sh[:, :5])


def shown(sh: torch.Tensor, direction: torch.Tensor) -> torch.Tensor:
    basis = geometry.sh_basis(
        torch.nn.functional.normalize(direction, dim=-1), geometry.sh_degree(sh.shape[-2])
    )
    return ((basis[..., None] * sh).sum(dim=-2) + 0.5).clamp_min(0.0)


def test_transformed_moves_covariance_and_color_with_the_object() -> None:
    gaussians, frame = make_gaussians(), make_frame()
    moved = gaussians.transformed(frame)
    matrix = geometry.unpack_symmetric(gaussians.covariances())
    expected = frame.scale**2 * frame.rotation @ matrix @ frame.rotation.T
    torch.testing.assert_close(geometry.unpack_symmetric(moved.covariances()), expected)
    direction = torch.nn.functional.normalize(torch.randn(20, 3, dtype=torch.float64), dim=1)
    before = shown(gaussians.sh, direction)
    after = shown(moved.sh, frame.apply_vector(direction))
    torch.testing.assert_close(after, before, atol=1e-12, rtol=0)


def test_transformed_there_and_back_is_the_same() -> None:
    gaussians, frame = make_gaussians(normals=torch.randn(20, 3, dtype=torch.float64)), make_frame()
    back = gaussians.transformed(frame).transformed(frame.inverse())
    for name in ("means", "scales", "sh", "opacities", "normals"):
        torch.testing.assert_close(
            getattr(back, name), getattr(gaussians, name), atol=1e-12, rtol=1e-12
        )
    torch.testing.assert_close(back.covariances(), gaussians.covariances())


def test_select_by_mask_and_index() -> None:
    gaussians = make_gaussians(labels=torch.arange(20, dtype=torch.int32))
    assert gaussians.select(gaussians.labels > 15).labels.tolist() == [16, 17, 18, 19]
    assert gaussians.select(torch.tensor([3, 1])).labels.tolist() == [3, 1]
    with pytest.raises(ValueError, match=r"mask must have shape \[20\]"):
        gaussians.select(torch.ones(19, dtype=torch.bool))


def test_cat_pads_sh_and_fills_labels() -> None:
    plain = make_gaussians(3, degree=1)
    rich = make_gaussians(2, degree=3, labels=torch.full((2,), INTERIOR, dtype=torch.int32))
    both = Gaussians.cat([plain, rich])
    assert both.count == 5 and both.sh_degree == 3
    assert both.labels is not None and both.labels.tolist() == [SURFACE] * 3 + [INTERIOR] * 2
    torch.testing.assert_close(both.sh[:3, :4], plain.sh)
    assert float(both.sh[:3, 4:].abs().max()) == 0.0
    with pytest.raises(ValueError, match="at least one"):
        Gaussians.cat([])


def test_from_colors_shows_these_colors() -> None:
    colors = torch.rand(6, 3)
    gaussians = Gaussians.from_colors(
        torch.randn(6, 3), torch.full((6,), 0.1), colors, label=INTERIOR
    )
    torch.testing.assert_close(gaussians.colors(), colors)
    assert gaussians.scales.shape == (6, 3) and gaussians.labels.tolist() == [INTERIOR] * 6
    torch.testing.assert_close(gaussians.with_colors(1 - colors).colors(), 1 - colors)


def test_to_changes_float_fields_only() -> None:
    gaussians = make_gaussians(labels=torch.zeros(20, dtype=torch.int32)).to(dtype=torch.float32)
    assert gaussians.dtype == torch.float32 and gaussians.labels.dtype == torch.int32


@pytest.mark.parametrize(
    ("field", "value", "message"),
    [
        (
            "means",
            float("nan"),
            "means must be finite, got NaN or infinite in 1 of 20 rows, first row 7",
        ),
        ("sh", float("inf"), "sh must be finite"),
        (
            "scales",
            0.0,
            "scales must be positive, got zero or negative in 1 of 20 rows, first row 7",
        ),
        ("opacities", 1.5, "opacities must lie in 0..1"),
    ],
)
def test_validated_names_the_bad_row(field: str, value: float, message: str) -> None:
    gaussians = make_gaussians()
    broken = getattr(gaussians, field).clone()
    broken.reshape(20, -1)[7, 0] = value
    with pytest.raises(InputError, match=message) as caught:
        gaussians.replace(**{field: broken}).validated()
    assert caught.value.hint


def test_validated_refuses_no_gaussians_and_returns_good_ones() -> None:
    gaussians = make_gaussians()
    assert gaussians.validated() is gaussians
    with pytest.raises(InputError, match="at least one Gaussian, got 0"):
        gaussians.select(torch.zeros(20, dtype=torch.bool)).validated()


# Frame and Camera


def test_frame_inverse_and_compose() -> None:
    first, second, points = make_frame(), make_frame(), torch.randn(9, 3, dtype=torch.float64)
    torch.testing.assert_close(first.inverse().apply(first.apply(points)), points)
    torch.testing.assert_close(
        second.compose(first).apply(points), second.apply(first.apply(points))
    )
    torch.testing.assert_close(Frame.from_dict(first.to_dict()).apply(points), first.apply(points))
    torch.testing.assert_close(Frame.identity().apply(points), points)


def test_frame_refuses_what_is_no_similarity() -> None:
    eye, zero = torch.eye(3), torch.zeros(3)
    with pytest.raises(ValueError, match="rotation must be orthogonal"):
        Frame(2 * eye, zero, 1.0)
    with pytest.raises(ValueError, match="rotation must be orthogonal"):
        Frame(-eye, zero, 1.0)
    with pytest.raises(ValueError, match="scale must be positive"):
        Frame(eye, zero, 0.0)
    with pytest.raises(ValueError, match="scale must be positive"):
        Frame(eye, torch.tensor([0.0, float("nan"), 0.0]), 1.0)


def test_camera_sees_the_same_after_moving_the_world() -> None:
    camera = Camera.look_at((2.0, 1.0, 0.5), (0.0, 0.0, 0.0), width=64, height=48)
    frame, points = make_frame(), 0.2 * torch.randn(30, 3, dtype=torch.float64)
    pixels, depth = camera.project(points)
    moved, deeper = camera.transformed(frame).project(frame.apply(points))
    torch.testing.assert_close(moved, pixels)
    torch.testing.assert_close(deeper, frame.scale * depth)
    torch.testing.assert_close(camera.transformed(frame).center(), frame.apply(camera.center()))


def test_camera_looks_at_the_middle_and_scales() -> None:
    camera = Camera.look_at((2.0, 1.0, 0.5), (0.0, 0.0, 0.0), width=64, height=48)
    origin = torch.zeros(1, 3, dtype=torch.float64)
    torch.testing.assert_close(
        camera.project(origin)[0], torch.tensor([[32.0, 24.0]], dtype=torch.float64)
    )
    half = camera.scaled(0.5)
    assert (half.width, half.height) == (32, 24)
    torch.testing.assert_close(
        half.project(origin)[0], torch.tensor([[16.0, 12.0]], dtype=torch.float64)
    )


def test_camera_projection_with_distortion_equals_opencv() -> None:
    cv2 = pytest.importorskip("cv2")
    distortion = (0.05, -0.13, 0.0006, -0.0012, 0.01)
    camera = Camera.look_at((0, 0, -3), (0, 0, 0), width=640, height=480, up=(0, 1, 0)).replace(
        distortion=distortion
    )
    points = torch.randn(20, 3, dtype=torch.float64) * 0.5
    rotation = cv2.Rodrigues(camera.viewmat[:3, :3].numpy())[0]
    expected, _ = cv2.projectPoints(
        points.numpy(),
        rotation,
        camera.viewmat[:3, 3].numpy(),
        camera.K.numpy(),
        torch.tensor(distortion).double().numpy(),
    )
    torch.testing.assert_close(
        camera.project(points)[0], torch.from_numpy(expected[:, 0]), atol=1e-6, rtol=0
    )


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"viewmat": torch.eye(3)}, r"viewmat must be a tensor of shape \[4, 4\]"),
        ({"viewmat": torch.full((4, 4), float("nan"))}, "must be finite"),
        ({"width": 0}, "size must be positive"),
        ({"K": torch.diag(torch.tensor([0.0, 1.0, 1.0]))}, "focal lengths must be positive"),
        ({"distortion": (0.1, 0.2, 0.3)}, "0, 4, 5 or 8 numbers"),
    ],
)
def test_camera_refuses_nonsense(change: dict[str, object], message: str) -> None:
    camera = Camera.look_at((0, 0, -3), (0, 0, 0), width=64, height=48)
    with pytest.raises(ValueError, match=message):
        camera.replace(**change)


def test_capture_splits_every_eighth() -> None:
    cameras = [
        Camera.look_at((3, i, 1), (0, 0, 0), width=8, height=8, name=f"{i:02d}") for i in range(17)
    ]
    capture = Capture(cameras, torch.zeros(0, 3), torch.zeros(0, 3), Path("."))
    train, held = capture.split()
    assert [camera.name for camera in held.cameras] == ["07", "15"] and len(train) == 15
    assert Capture(cameras[:3], torch.zeros(0, 3), torch.zeros(0, 3), Path(".")).split()[1] is None
    with pytest.raises(ValueError, match="every must be at least 2"):
        capture.split(1)
    with pytest.raises(ValueError, match="at least one camera"):
        Capture([], torch.zeros(0, 3), torch.zeros(0, 3), Path("."))


# Particles and Solid


def test_particles_at_rest_select_and_cat() -> None:
    position = torch.rand(5, 3, dtype=torch.float64)
    ones = torch.ones(5, dtype=torch.float64)
    particles = Particles.at_rest(
        position, mass=ones, volume=ones, velocity=(0, 0, -1), body=2, alpha=-0.04
    )
    assert particles.body.tolist() == [2] * 5 and particles.deformation is not None
    both = Particles.cat([particles, particles.select(torch.tensor([0]))])
    assert both.count == 6 and both.validated() is both
    with pytest.raises(ValueError, match="in all parts or none"):
        Particles.cat([particles, particles.replace(deformation=None)])


def test_particles_validated_names_the_field() -> None:
    ones = torch.ones(5)
    particles = Particles.at_rest(torch.rand(5, 3), mass=ones, volume=ones)
    with pytest.raises(
        InputError,
        match="mass must be finite and positive, got otherwise in 1 of 5 rows, first row 2",
    ):
        particles.replace(mass=torch.tensor([1.0, 1, 0, 1, 1])).validated()
    with pytest.raises(InputError, match="at least one particle"):
        particles.select(torch.zeros(5, dtype=torch.bool)).validated()


def test_solid_survives_saving(tmp_path: Path) -> None:
    solid = make_solid()
    save_solid(solid, tmp_path / "melon.ply")
    assert sorted(file.name for file in tmp_path.iterdir()) == ["melon.ply", "melon.volume.npz"]
    again = load_solid(tmp_path / "melon.ply")
    for name in ("occupancy", "depth", "origin", "color", "regions"):
        assert torch.equal(getattr(again, name), getattr(solid, name)), name
    assert again.report == solid.report and again.voxel == solid.voxel
    assert torch.equal(again.gaussians.labels, solid.gaussians.labels)
    torch.testing.assert_close(again.frame.rotation, solid.frame.rotation)


def test_solid_voxels_and_points_agree() -> None:
    solid = make_solid()
    centers = solid.voxel_centers()
    assert len(centers) == int(solid.occupancy.sum()) == 18
    assert solid.volume == pytest.approx(18 * 0.25**3)
    assert bool(solid.contains(centers).all()) and not bool(solid.contains(centers + 10).any())
    torch.testing.assert_close(solid.depth_at(centers), solid.depth[solid.occupancy])
    torch.testing.assert_close(solid.color_at(centers), solid.color[solid.occupancy])
    assert float(solid.depth_at(centers + 10).abs().max()) == 0.0


def test_solid_depth_is_linear_between_centers() -> None:
    solid = make_solid()
    ramp = torch.arange(4.0)[:, None, None].expand(4, 5, 6).contiguous()
    points = torch.tensor([[-1.0 + 0.25 * 1.9, 1.1, 2.7]])
    assert float(solid.replace(depth=ramp).depth_at(points)) == pytest.approx(1.4, abs=1e-5)


def test_solid_moves_by_its_frame_only() -> None:
    solid, frame = make_solid(), make_frame()
    moved = solid.transformed(frame)
    point = torch.randn(1, 3, dtype=torch.float64)
    torch.testing.assert_close(moved.frame.apply(point), frame.apply(solid.frame.apply(point)))
    assert torch.equal(moved.gaussians.means, solid.gaussians.means)


def test_solid_refuses_missing_labels_and_bad_voxel() -> None:
    solid = make_solid()
    with pytest.raises(ValueError, match="must carry labels"):
        solid.replace(gaussians=solid.gaussians.replace(labels=None))
    with pytest.raises(ValueError, match="voxel must be positive"):
        solid.replace(voxel=0.0)
    with pytest.raises(ValueError, match="has no colours"):
        solid.replace(color=None).color_at(torch.zeros(1, 3))


def test_solid_load_says_what_is_missing_or_damaged(tmp_path: Path) -> None:
    save_solid(make_solid(), tmp_path / "melon.ply")
    volume = tmp_path / "melon.volume.npz"
    whole = volume.read_bytes()
    volume.write_bytes(whole[: len(whole) // 2])
    with pytest.raises(InputError, match="file is damaged"):
        load_solid(tmp_path / "melon.ply")
    volume.unlink()
    with pytest.raises(InputError, match=r"needs melon\.volume\.npz beside it"):
        load_solid(tmp_path / "melon.ply")
