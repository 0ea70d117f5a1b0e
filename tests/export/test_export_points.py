"""Material points are read back by VTK, trimesh and json, not by us."""

from __future__ import annotations

import json
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import numpy as np
import pytest
import torch
from export_run import FPS, FRAMES, make_run

from gsfluent.export.write import ExportOptions, export
from gsfluent.io.vtk import save_vti
from gsfluent.results.frames import SavedFrame, load_frame

CPU = torch.device("cpu")


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, SavedFrame]:
    root = tmp_path_factory.mktemp("points")
    out = make_run(root / "run")
    export(out, ["vtk", "points", "vti"], device=CPU, to=root, options=ExportOptions())
    return root, load_frame(out / "stages" / "simulate", FRAMES - 1)


def test_vtk_opens_in_vtk(written: tuple[Path, SavedFrame]) -> None:
    pytest.importorskip("vtkmodules")
    from vtkmodules.util.numpy_support import vtk_to_numpy
    from vtkmodules.vtkIOLegacy import vtkPolyDataReader

    root, saved = written
    reader = vtkPolyDataReader()
    reader.SetFileName(str(root / "particles" / f"particles_{FRAMES:04d}.vtk"))
    reader.ReadAllScalarsOn()
    reader.ReadAllVectorsOn()
    reader.Update()
    data = reader.GetOutput()
    assert data.GetNumberOfVerts() == len(saved.positions)
    assert np.allclose(vtk_to_numpy(data.GetPoints().GetData()), saved.positions.numpy())
    fields = data.GetPointData()
    for name, truth in (
        ("damage", saved.damage),
        ("fragment", saved.fragments),
        ("velocity", saved.velocity),
        ("material", saved.material),
        ("body", saved.body),
        ("volume", saved.volumes),
    ):
        assert np.allclose(vtk_to_numpy(fields.GetArray(name)), truth.numpy()), name


def test_a_series_tells_the_times(written: tuple[Path, SavedFrame]) -> None:
    root, _ = written
    series = json.loads((root / "particles" / "particles.vtk.series").read_text())
    assert series["file-series-version"] == "1.0"
    assert [entry["time"] for entry in series["files"]] == pytest.approx(
        [index / FPS for index in range(FRAMES)]
    )
    assert all((root / "particles" / entry["name"]).is_file() for entry in series["files"])
    rows = ElementTree.parse(root / "density" / "density.pvd").getroot().findall(".//DataSet")
    assert [float(row.get("timestep", "")) for row in rows] == pytest.approx(
        [index / FPS for index in range(FRAMES)]
    )
    assert all((root / "density" / str(row.get("file"))).is_file() for row in rows)


def test_points_open_in_trimesh(written: tuple[Path, SavedFrame]) -> None:
    import trimesh

    root, saved = written
    cloud = trimesh.load(root / "points" / f"points_{FRAMES:04d}.ply")
    assert np.allclose(cloud.vertices, saved.positions.numpy(), atol=1e-6)
    rows = cloud.metadata["_ply_raw"]["vertex"]["data"]
    assert np.allclose(rows["vz"], saved.velocity[:, 2].numpy(), atol=1e-3)
    assert (rows["fragment"] == saved.fragments.numpy()).all()


def read_vti(path: Path) -> tuple[np.ndarray, np.ndarray, np.ndarray, float]:
    """Density and damage [X, Y, Z], origin and spacing, by VTK."""
    pytest.importorskip("vtkmodules")
    from vtkmodules.util.numpy_support import vtk_to_numpy
    from vtkmodules.vtkIOXML import vtkXMLImageDataReader

    reader = vtkXMLImageDataReader()
    reader.SetFileName(str(path))
    reader.Update()
    data = reader.GetOutput()
    shape = data.GetDimensions()[::-1]
    fields = [
        vtk_to_numpy(data.GetPointData().GetArray(i)).reshape(shape).transpose(2, 1, 0)
        for i in range(2)
    ]
    return fields[0], fields[1], np.array(data.GetOrigin()), data.GetSpacing()[0]


def test_density_holds_the_matter(written: tuple[Path, SavedFrame]) -> None:
    root, saved = written
    density, damage, origin, step = read_vti(root / "density" / f"density_{FRAMES:04d}.vti")
    volume = density.astype(np.float64).sum() * step**3
    assert volume == pytest.approx(float(saved.volumes.sum()), rel=1e-5)
    # trilinear weights keep the centre of mass exactly
    index = np.stack(np.meshgrid(*(np.arange(n) for n in density.shape), indexing="ij"), axis=-1)
    center = (density[..., None] * (origin + step * index)).sum((0, 1, 2)) / density.sum()
    assert np.allclose(center, saved.positions.mean(0).numpy(), atol=1e-5)
    assert 0.9 < density.max() < 1.6 and density[0].max() == 0.0
    assert damage.max() == pytest.approx(1.0, abs=1e-5)


def test_a_volume_is_not_transposed(tmp_path: Path) -> None:
    values = np.arange(2 * 3 * 5, dtype=np.float32).reshape(2, 3, 5)
    fields = {"a": values, "b": np.zeros_like(values)}
    save_vti(tmp_path / "a.vti", fields, origin=(1, 2, 3), spacing=0.5)
    got, _, origin, step = read_vti(tmp_path / "a.vti")
    assert (got == values).all() and origin.tolist() == [1, 2, 3] and step == 0.5
    with pytest.raises(ValueError, match="one shape"):
        save_vti(tmp_path / "b.vti", fields | {"c": values[:1]}, origin=(0, 0, 0), spacing=1)
