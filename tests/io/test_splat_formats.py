"""Splat files of other programs, against the ``.ply`` that they were made from.

``foreign/forty.ply`` holds 40 random splats of SH degree 1. ``forty.sog``, ``forty.spz`` and
``forty_v4.spz`` were written from it by PlayCanvas' splat-transform 2.7.1, ``forty_0.ksplat`` to
``forty_2.ksplat`` (one per level) by GaussianSplats3D 0.4.7. Checkpoints are written here,
by torch, in the layouts of gsplat 1.5 and nerfstudio 1.1.
"""

from __future__ import annotations

import gzip
import io
import json
import os
import struct
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch

from gsfluent.data import Frame, Gaussians
from gsfluent.errors import InputError
from gsfluent.geometry import quaternion_to_matrix
from gsfluent.io import kind_of, load_splats
from gsfluent.io.splats import forge
from gsfluent.io.splats.load import FORGED, save_forged
from gsfluent.io.splats.splat import save_splat
from gsfluent.io.splats.spz import save_spz

FOREIGN = Path(__file__).parent / "foreign"


@pytest.fixture(scope="module")
def truth() -> Gaussians:
    return load_splats(FOREIGN / "forty.ply")


def covariances(splats: Gaussians) -> torch.Tensor:
    axes = quaternion_to_matrix(splats.quats) * splats.scales[:, None, :]
    return axes @ axes.transpose(1, 2)


def errors(found: Gaussians, truth: Gaussians) -> dict[str, float]:
    """Largest errors, rows matched by position: [units], shares, and absolute.

    Of SH rest the median over the splats: a palette has fewer rows than there are splats.
    """
    nearest = torch.cdist(truth.means, found.means).argmin(dim=1)
    assert len(set(nearest.tolist())) == truth.count == found.count
    found = found.select(nearest)
    wanted = covariances(truth)
    off = (covariances(found) - wanted).abs().amax(dim=(1, 2)) / wanted.abs().amax(dim=(1, 2))
    shares = min(found.sh.shape[1], truth.sh.shape[1])
    harmonics = (found.sh[:, :shares] - truth.sh[:, :shares]).abs().amax(dim=2)
    rest = harmonics[:, 1:].amax(dim=1).median() if shares > 1 else 0.0
    return {
        "means": float((found.means - truth.means).abs().max()),
        "shape": float(off.max()),
        "opacity": float((found.opacities - truth.opacities).abs().max()),
        "color": float(harmonics[:, 0].max()),
        "rest": float(rest),
    }


# what the format itself rounds: bits of positions and quaternions, steps of scales and colours
@pytest.mark.parametrize(("name", "bounds"), [
    ("forty.spz", {"means": 2e-4, "shape": 0.08, "opacity": 0.003, "color": 0.014, "rest": 0.04}),
    ("forty.sog", {"means": 1e-3, "shape": 0.04, "opacity": 0.004, "color": 0.01, "rest": 0.01}),
    ("forty_0.ksplat", {"means": 0, "shape": 1e-5, "opacity": 0.004, "color": 0.015, "rest": 0}),
    ("forty_1.ksplat", {"means": 1e-4, "shape": 0.004, "opacity": 0.004, "color": 0.015,
                        "rest": 1e-3}),
    ("forty_2.ksplat", {"means": 1e-4, "shape": 0.004, "opacity": 0.004, "color": 0.015,
                        "rest": 0.012}),
])  # fmt: skip
def test_files_of_other_programs(name: str, bounds: dict[str, float], truth: Gaussians) -> None:
    found = load_splats(FOREIGN / name)
    assert found.sh_degree == 1 and kind_of(FOREIGN / name) == "splats"
    off = errors(found, truth)
    assert {key: value for key, value in off.items() if value > bounds[key]} == {}


def test_our_own_splat_and_spz_come_back(tmp_path: Path, truth: Gaussians) -> None:
    save_splat(truth, tmp_path / "a.splat")
    off = errors(load_splats(tmp_path / "a.splat"), truth.with_sh_degree(0))
    assert off["means"] == 0 and off["shape"] < 0.03 and off["color"] < 0.01
    turned = truth.transformed(Frame(torch.diag(torch.tensor([1.0, -1, -1])), torch.zeros(3), 1.0))
    for version in (2, 3):
        save_spz(turned, tmp_path / "a.spz", version=version)
        off = errors(load_splats(tmp_path / "a.spz"), truth)
        assert off["means"] < 1e-5 and off["shape"] < 0.25 and off["rest"] < 0.04


@pytest.mark.parametrize(("kind", "bounds"), [
    (".ksplat", {"means": 0, "shape": 1e-5, "opacity": 0.004, "color": 0.015, "rest": 1e-6}),
    (".sog", {"means": 1e-3, "shape": 0.04, "opacity": 0.004, "color": 0.02, "rest": 0.01}),
])  # fmt: skip
def test_what_gaussforge_writes_for_us_comes_back(
    kind: str, bounds: dict[str, float], tmp_path: Path, truth: Gaussians
) -> None:
    pytest.importorskip("gaussforge", reason="the extra formats is not installed")
    save_forged(truth, tmp_path / f"a{kind}")
    found = load_splats(tmp_path / f"a{kind}")
    off = errors(found, truth)
    assert {key: value for key, value in off.items() if value > bounds[key]} == {}
    assert found.sh_degree == truth.sh_degree
    wide = truth.with_sh_degree(3)
    save_forged(wide, tmp_path / f"b{kind}")
    assert load_splats(tmp_path / f"b{kind}").sh_degree == FORGED[kind]


def test_version_4_of_spz_is_read_by_gaussforge(
    tmp_path: Path, truth: Gaussians, without: Callable[[str], None]
) -> None:
    pytest.importorskip("gaussforge", reason="the extra formats is not installed")
    off = errors(load_splats(FOREIGN / "forty_v4.spz"), truth)
    assert off["means"] < 2e-4 and off["shape"] < 0.08 and off["rest"] < 0.04
    (tmp_path / "torn.spz").write_bytes((FOREIGN / "forty_v4.spz").read_bytes()[:600])
    with pytest.raises(InputError, match=r"torn.spz: gaussforge cannot convert it \(it is damaged"):
        load_splats(tmp_path / "torn.spz")
    without("gaussforge")
    with pytest.raises(InputError, match=r"forty_v4.spz.*needs gaussforge"):
        load_splats(FOREIGN / "forty_v4.spz")


def test_forged_files_have_names_of_their_own(tmp_path: Path, truth: Gaussians) -> None:
    with pytest.raises(InputError, match="not a name of these"):
        save_forged(truth, tmp_path / "a.ply")


def trained(truth: Gaussians) -> torch.nn.ParameterDict:
    """The splats as a trainer holds them: quaternions of any length, logits, logarithms."""
    values = {
        "means": truth.means.clone(), "quats": 2 * truth.quats, "scales": truth.scales.log(),
        "opacities": torch.logit(truth.opacities), "sh0": truth.sh[:, :1].clone(),
        "shN": truth.sh[:, 1:].clone(),
    }  # fmt: skip
    return torch.nn.ParameterDict({k: torch.nn.Parameter(v) for k, v in values.items()})


def splatfacto(truth: Gaussians) -> dict[str, Any]:
    held = trained(truth)
    optimizer = torch.optim.Adam(held.values())
    sum(value.sum() for value in held.values()).backward()
    optimizer.step()
    names = {"sh0": "features_dc", "shN": "features_rest"}
    values = {names.get(k, k): v for k, v in trained(truth).state_dict().items()}
    values["features_dc"] = values["features_dc"][:, 0]
    values["opacities"] = values["opacities"][:, None]
    pipeline: dict[str, Any] = {f"_model.gauss_params.{k}": v for k, v in values.items()}
    pipeline["_model.camera_optimizer.pose"] = torch.zeros(3, 6, dtype=torch.bfloat16)
    return {"step": 9, "pipeline": pipeline, "optimizers": {"means": optimizer.state_dict()}}


def test_checkpoints(tmp_path: Path, truth: Gaussians) -> None:
    torch.save({"step": 9, "splats": trained(truth).state_dict()}, tmp_path / "a.pt")
    torch.save(splatfacto(truth), tmp_path / "a.ckpt")
    for name in ("a.pt", "a.ckpt"):
        off = errors(load_splats(tmp_path / name), truth)
        assert max(off.values()) < 1e-5
    # without bands splatfacto trains the logit of the colour
    plain = splatfacto(truth)
    plain["pipeline"]["_model.gauss_params.features_rest"] = torch.zeros(truth.count, 0, 3)
    plain["pipeline"]["_model.gauss_params.features_dc"] = torch.logit(truth.colors().clamp(0, 1))
    torch.save(plain, tmp_path / "b.ckpt")
    found = load_splats(tmp_path / "b.ckpt").colors()
    assert (found - truth.colors().clamp(0, 1)).abs().max() < 1e-5


class Evil:
    def __reduce__(self) -> tuple[Any, ...]:
        return os.mkdir, ("hacked",)


def test_a_checkpoint_runs_nothing(
    tmp_path: Path, truth: Gaussians, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    values = {"splats": trained(truth).state_dict(), "note": Evil()}
    torch.save(values, "a.pt")
    with pytest.raises(InputError, match=r"names \w+\.mkdir, which is no tensor"):
        load_splats("a.pt")
    assert not Path("hacked").exists()
    torch.save({"splats": trained(truth).state_dict(), "note": bytearray(8)}, "b.pt")
    with pytest.raises(InputError, match="is no tensor"):
        load_splats("b.pt")
    del values["note"]
    values["splats"]["means"] = values["splats"]["means"].expand(40, 3)
    torch.save(values, "c.pt")
    lying = rewritten(Path("c.pt"), "data.pkl", lambda raw: raw.replace(b"K(K\x03\x86", b"Kdf", 1))
    with pytest.raises(InputError, match="damaged"):
        load_splats(lying)


def rewritten(path: Path, ending: str, change: Any) -> Path:
    """A copy of a zip with one member changed."""
    out = path.with_name(f"changed_{path.name}")
    with zipfile.ZipFile(path) as old, zipfile.ZipFile(out, "w") as new:
        for item in old.infolist():
            data = old.read(item)
            new.writestr(item, change(data) if item.filename.endswith(ending) else data)
    return out


@pytest.mark.parametrize(("name", "data", "said"), [
    pytest.param("a.splat", b"", "no rows of 32", id="splat-empty"),
    pytest.param("a.splat", bytes(33), "no rows of 32", id="splat-torn"),
    pytest.param("a.spz", b"PK", "no .spz", id="spz-zip"),
    pytest.param("a.spz", gzip.compress(b"NG"), "within its header", id="spz-torn"),
    pytest.param("a.ksplat", bytes(5000), "version 0.0", id="ksplat-zeros"),
    pytest.param("a.ksplat", b"\0\1", "damaged", id="ksplat-torn"),
    pytest.param("a.ksplat", b"\0\1" + bytes(4094), "no section", id="ksplat-empty"),
    pytest.param("a.sog", b"PK", "damaged", id="sog-torn"),
    pytest.param("a.pt", b"PK", "no checkpoint", id="pt-torn"),
])  # fmt: skip
def test_what_is_no_such_file(tmp_path: Path, name: str, data: bytes, said: str) -> None:
    (tmp_path / name).write_bytes(data)
    with pytest.raises(InputError, match=said) as caught:
        load_splats(tmp_path / name)
    assert name in caught.value.what and caught.value.hint


def test_other_versions_say_what_reads_them(tmp_path: Path) -> None:
    later = bytearray((FOREIGN / "forty_v4.spz").read_bytes())
    later[4] = 5
    (tmp_path / "later.spz").write_bytes(later)
    with pytest.raises(InputError, match="version 5") as caught:
        load_splats(tmp_path / "later.spz")
    assert "splat-transform" in caught.value.hint
    later[4:12] = struct.pack("<II", 4, 2**31)
    (tmp_path / "huge.spz").write_bytes(later)
    with pytest.raises(InputError, match="above the limit"):
        load_splats(tmp_path / "huge.spz")

    def older(raw: bytes) -> bytes:
        return json.dumps(json.loads(raw) | {"version": 1}).encode()

    (tmp_path / "forty.sog").write_bytes((FOREIGN / "forty.sog").read_bytes())
    with pytest.raises(InputError, match="not version 2"):
        load_splats(rewritten(tmp_path / "forty.sog", "meta.json", older))


def test_a_sog_without_its_palette_loses_only_that(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    whole = load_splats(FOREIGN / "forty.sog")
    with (
        zipfile.ZipFile(FOREIGN / "forty.sog") as old,
        zipfile.ZipFile(tmp_path / "a.sog", "w") as new,
    ):
        for item in old.infolist():
            if "shN" not in item.filename:
                new.writestr(item, old.read(item))
    plain = load_splats(tmp_path / "a.sog")
    assert whole.sh.shape[1] == 4 and torch.equal(plain.sh, whole.sh[:, :1])
    assert torch.equal(plain.means, whole.means)
    assert "same from all sides" in caplog.text


def test_a_spz_that_grows_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("GSFLUENT_MAX_UNPACKED_BYTES", "1e6")
    stream = io.BytesIO()
    with gzip.GzipFile(fileobj=stream, mode="wb") as packed:
        packed.write(bytes(1 << 24))
    (tmp_path / "a.spz").write_bytes(stream.getvalue())
    with pytest.raises(InputError, match="above the limit"):
        load_splats(tmp_path / "a.spz")


def test_a_conversion_that_never_ends_is_ended(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    pytest.importorskip("gaussforge", reason="the extra formats is not installed")
    monkeypatch.setattr(forge, "PATIENCE", 0.2)
    monkeypatch.setattr(forge, "_CONVERT", "import time\ntime.sleep(60)")
    with pytest.raises(InputError, match="has worked on it for 0"):
        forge.converted(b"", "ply", "sog", tmp_path / "slow.sog")
