"""The meshes of a run's fragments, opened and drawn by VTK: docs/images/export_meshes.png.

python scripts/pictures/export_meshes.py demo_out --frames 0 6 9 -o docs/images/export_meshes.png
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path

import numpy as np
import torch
from vtkmodules.util.numpy_support import vtk_to_numpy
from vtkmodules.vtkFiltersCore import vtkPolyDataNormals
from vtkmodules.vtkIOPLY import vtkPLYReader
from vtkmodules.vtkRenderingCore import (
    vtkActor,
    vtkPolyDataMapper,
    vtkRenderer,
    vtkRenderWindow,
    vtkWindowToImageFilter,
)
from vtkmodules.vtkRenderingOpenGL2 import vtkOpenGLRenderer  # noqa: F401 - registers the drawing

from gsfluent.export.write import ExportOptions, export


def draw(path: Path, size: tuple[int, int]) -> np.ndarray:
    """A mesh from the front right, [H, W, 3]."""
    reader = vtkPLYReader()
    reader.SetFileName(str(path))
    normals = vtkPolyDataNormals()
    normals.SetInputConnection(reader.GetOutputPort())
    normals.SplittingOff()
    mapper = vtkPolyDataMapper()
    mapper.SetInputConnection(normals.GetOutputPort())
    actor = vtkActor()
    actor.SetMapper(mapper)
    renderer = vtkRenderer()
    renderer.SetBackground(0.82, 0.82, 0.82)
    renderer.AddActor(actor)
    window = vtkRenderWindow()
    window.SetOffScreenRendering(1)
    window.SetSize(*size)
    window.AddRenderer(renderer)
    reader.Update()
    points = vtk_to_numpy(reader.GetOutput().GetPoints().GetData())
    center = np.median(points, axis=0)
    reach = float(np.percentile(np.linalg.norm(points - center, axis=1), 90))
    camera = renderer.GetActiveCamera()
    camera.SetFocalPoint(*center)
    camera.SetPosition(*(center + 5.5 * reach * np.array([0.62, -0.68, 0.4])))
    camera.SetViewUp(0, 0, 1)
    camera.SetViewAngle(28)
    renderer.ResetCameraClippingRange()
    window.Render()
    grab = vtkWindowToImageFilter()
    grab.SetInput(window)
    grab.Update()
    image = grab.GetOutput()
    width, height, _ = image.GetDimensions()
    pixels = vtk_to_numpy(image.GetPointData().GetScalars()).reshape(height, width, 3)
    return pixels[::-1]


def main() -> None:
    from PIL import Image

    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("run", type=Path, help="folder of a finished run")
    parser.add_argument("--frames", type=int, nargs="+", default=[0], help="which, from 0")
    parser.add_argument("-o", "--out", type=Path, required=True, help="the picture")
    parser.add_argument("--size", type=int, nargs=2, default=(440, 360), help="of each view")
    given = parser.parse_args()
    views = []
    with tempfile.TemporaryDirectory() as folder:
        for frame in given.frames:
            options = ExportOptions(frames=str(frame))
            export(
                given.run, ["meshes"], device=torch.device("cpu"), to=Path(folder), options=options
            )
            path = Path(folder) / "meshes" / f"frame_{frame + 1:04d}.ply"
            views.append(draw(path, (given.size[0], given.size[1])))
    Image.fromarray(np.concatenate(views, axis=1)).quantize(200).save(given.out, optimize=True)


if __name__ == "__main__":
    main()
