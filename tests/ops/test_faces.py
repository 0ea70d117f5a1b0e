"""Face elements against their definition, one operation at a time."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from gsfluent import geometry
from gsfluent.ops import FaceFit, FaceSites, face_elements, find_faces
from gsfluent.ops.reference import faces as reference

DEVICES = ["cpu", pytest.param("cuda", marks=pytest.mark.cuda)]
FIT = FaceFit(0.85, 0.3, 0.55, 0.3, 1.5, 1.5, 0.3, 0.1, 0.25)


def scene(device: str = "cpu", dtype: torch.dtype = torch.float64) -> tuple[Tensor, FaceSites]:
    """A jittered lattice of points, half of whose links are open, and places of half its pitch."""
    chance = torch.Generator().manual_seed(1)
    line = torch.arange(5, dtype=torch.float64)
    rest = torch.cartesian_prod(line, line, line)
    rest = rest + 0.2 * torch.rand(rest.shape, generator=chance, dtype=torch.float64)
    near = torch.cdist(rest, rest).topk(12, largest=False).indices
    opened = torch.rand(near.shape, generator=chance) < 0.5
    opened[:, 0] = False
    line = torch.arange(11, dtype=torch.float64) / 2.2
    means = torch.cartesian_prod(line, line, line)
    means = means + 0.1 * torch.rand(means.shape, generator=chance, dtype=torch.float64)
    outward = torch.randn(means.shape, generator=chance, dtype=torch.float64)
    sites = FaceSites(
        means=means,
        owner=torch.cdist(means, rest).argmin(dim=1),
        pitch=0.4 + 0.1 * torch.rand(len(means), generator=chance, dtype=torch.float64),
        outward=torch.nn.functional.normalize(outward, dim=1),
        depth=torch.rand(len(means), generator=chance, dtype=torch.float64),
        near=near, opened=opened, rest=rest,
    )  # fmt: skip
    rows = torch.arange(len(means)).flip(0)[::2]
    cast = (v.to(device, dtype) if v.is_floating_point() else v.to(device) for v in sites)
    return rows.to(device), FaceSites(*cast)


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize(("dtype", "bar"), [(torch.float32, 2e-4), (torch.float64, 1e-10)])
def test_elements_are_as_defined(device: str, dtype: torch.dtype, bar: float) -> None:
    rows, sites = scene()
    want = reference.find_faces(rows, sites, FIT)
    given = scene(device, dtype)
    got = find_faces(*given, FIT)
    assert 200 < int(want[:, :-1].sum()) and 100 < int(want[:, -1].sum()) < len(rows)
    # float32 may see a border otherwise on which a place just lies
    assert int((got.cpu() != want).sum()) <= (2 if dtype == torch.float32 else 0)
    m, column = want.nonzero().unbind(dim=1)
    right = reference.face_elements(rows[m], column, sites, FIT)
    made = face_elements(rows[m].to(device), column.to(device), given[1], FIT)
    assert torch.equal(made[0].cpu(), right[0])
    assert [part.dtype for part in made[1:]] == [dtype] * 4
    for part, true in ((1, right[1]), (3, right[3]), (4, right[4])):
        assert (made[part].cpu().double() - true).abs().max() < bar
    turned, true = (geometry.quaternion_to_matrix(q.cpu().double()) for q in (made[2], right[2]))
    # where an edge is about as near as another, the first axis may point to either
    off = (turned - true).abs().amax(dim=(1, 2))
    assert (off > bar).sum() <= (4 if dtype == torch.float32 else 0)
    assert (made[3][:, 0] < made[3][:, 1]).any()  # an edge makes some narrow


@pytest.mark.parametrize("device", DEVICES)
def test_rows_that_are_none_have_no_elements(device: str) -> None:
    rows, sites = scene(device)
    bad = torch.tensor([-1, 1 << 40, len(sites.means)], device=device)
    assert not find_faces(bad, sites, FIT).any()
    lost = sites._replace(owner=torch.full_like(sites.owner, -3))
    assert not find_faces(rows, lost, FIT).any()
    astray = sites._replace(near=torch.where(sites.opened, 1 << 50, sites.near))
    assert not find_faces(rows, astray, FIT)[:, 1:-1].any()
    made = face_elements(bad, torch.zeros_like(bad), sites, FIT)
    assert made[1].tolist() == [[0.0] * 3] * 3 and made[2].tolist() == [[1.0, 0.0, 0.0, 0.0]] * 3
    beyond = face_elements(rows[:2], torch.tensor([13, -1], device=device), sites, FIT)
    assert beyond[3].tolist() == [[0.0] * 3] * 2
    none = face_elements(rows[:0], rows[:0], sites, FIT)
    assert [tuple(part.shape) for part in none] == [(0,), (0, 3), (0, 4), (0, 3), (0, 3)]
    assert find_faces(rows[:0], sites, FIT).shape == (0, 13)


def test_errors_and_registration() -> None:
    rows, sites = scene()
    with pytest.raises(ValueError, match="pitch"):
        find_faces(rows, sites._replace(pitch=sites.pitch[:5]), FIT)
    with pytest.raises(TypeError, match="opened"):
        find_faces(rows, sites._replace(opened=sites.opened.int()), FIT)
    with pytest.raises(ValueError, match="column"):
        face_elements(rows, rows[:3], sites, FIT)
    lib, names = torch.ops.gsfluent, ("test_schema", "test_faketensor")
    with pytest.raises(RuntimeError, match="fit must be 9 numbers"):
        lib.find_faces(rows, *sites, [0.5] * 8)
    torch.library.opcheck(lib.find_faces.default, (rows, *sites, list(FIT)), test_utils=names)
    arguments = (rows, torch.zeros_like(rows), *sites, list(FIT))
    torch.library.opcheck(lib.face_elements.default, arguments, test_utils=names)
