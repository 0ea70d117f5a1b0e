"""Meshes of pieces: closed whatever the labels, fitting their neighbours, of full volume."""

from __future__ import annotations

import numpy as np
import pytest
import torch
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from partition_shapes import EDGE, ball, cube, points_of

from gsfluent.data import Frame, Solid
from gsfluent.pipeline.matter.fragments import ranked
from gsfluent.pipeline.partition.mesh import PieceMesh, Surfaces
from gsfluent.pipeline.partition.tree import Partition

SHAPES = {"ball": ball(False), "shell": ball(True), "cube": cube()}


def partition_of(solid: Solid, spacing: float = EDGE / 11) -> tuple[Partition, torch.Tensor]:
    rest, spacing = points_of(solid, spacing)
    return Partition(solid, Frame.identity(), rest, spacing, 0, 0.25), rest


def shatter(partition: Partition, rest: torch.Tensor, seed: int, counts: list[int]) -> list[int]:
    """Split into Voronoi cells, then one of these, and so on; all regions that there are."""
    draw = torch.Generator().manual_seed(seed)
    owner = torch.zeros(len(rest), dtype=torch.int64)
    regions = [0]
    for count in counts:
        region = regions[int(torch.randint(len(regions), (1,), generator=draw))]
        rows = (owner == region).nonzero()[:, 0]
        seeds = rest[rows[torch.randperm(len(rows), generator=draw)[:count]]]
        names, rank = ranked(torch.cdist(rest[rows], seeds).argmin(dim=1), rest[rows])
        ids = [region, *range(len(regions), len(regions) + len(names) - 1)]
        done = partition.split(region, rest[rows], rank, ids)
        owner = partition.assign(owner, done, rest, rows, rank)
        regions += ids[1:]
    return regions


def closed(mesh: PieceMesh) -> trimesh.Trimesh:
    """The mesh, found watertight as it is and when what lies in one place is one vertex."""
    found = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    assert found.is_watertight and found.is_winding_consistent
    assert trimesh.Trimesh(mesh.vertices, mesh.faces, process=True).is_watertight
    # one fan of triangles around every vertex: as many edges at it as triangles, and connected
    corner = np.arange(mesh.faces.size)
    sorted_edges = np.sort(found.edges, axis=1)
    order = np.lexsort(sorted_edges.T)
    twins = order.reshape(-1, 2)
    links = []
    for end in (0, 1):  # corners of twin half edges at the same vertex
        here = found.edges_face * 3 + np.tile([0, 1, 2], len(mesh.faces))
        there = found.edges_face * 3 + np.tile([1, 2, 0], len(mesh.faces))
        at = (here, there)
        links.append(np.stack([at[end][twins[:, 0]], at[1 - end][twins[:, 1]]], axis=1))
    groups = trimesh.graph.connected_component_labels(np.concatenate(links), len(corner))
    assert len(np.unique(groups)) == len(mesh.vertices)
    return found


def keys(vertices: np.ndarray) -> set[bytes]:
    return {row.tobytes() for row in np.ascontiguousarray(vertices)}


@settings(max_examples=8, deadline=None)
@given(
    shape=st.sampled_from(sorted(SHAPES)),
    seed=st.integers(0, 10**6),
    counts=st.lists(st.integers(2, 7), min_size=1, max_size=3),
)
def test_pieces_are_closed_and_fill_the_solid(shape: str, seed: int, counts: list[int]) -> None:
    solid = SHAPES[shape]
    partition, rest = partition_of(solid)
    regions = shatter(partition, rest, seed, counts)
    surfaces = Surfaces(partition)
    there = [r for r in regions if bool((surfaces.inner == r).any() | (surfaces.outer == r).any())]
    volumes = [closed(surfaces.mesh([region])).volume for region in there]
    assert min(volumes) > 0.0
    # the mesh of a thin shell is 0.7 % short before anything breaks
    assert sum(volumes) == pytest.approx(solid.volume, rel=0.015 if shape == "shell" else 0.01)
    whole = surfaces.mesh(regions)
    assert whole.skin.all() and closed(whole).volume == pytest.approx(sum(volumes), rel=1e-9)
    assert whole.volume == pytest.approx(sum(volumes), rel=1e-9)


@settings(max_examples=8, deadline=None)
@given(seed=st.integers(0, 10**6), labels=st.integers(2, 6), holes=st.booleans())
def test_any_labels_whatsoever_give_closed_meshes(seed: int, labels: int, holes: bool) -> None:
    # every face of the grid with four unlike corners occurs here, and every corner of pieces
    partition, _ = partition_of(SHAPES["cube"], EDGE / 6)
    draw = torch.Generator().manual_seed(seed)
    partition.region = torch.randint(labels, partition.shape, generator=draw).to(torch.int32)
    if holes:
        partition.region[torch.rand(partition.shape, generator=draw) < 0.3] = -1
    surfaces = Surfaces(partition)
    for region in range(labels):
        closed(surfaces.mesh([region]))
    closed(surfaces.mesh([0, labels - 1]))
    closed(surfaces.mesh(list(range(labels))))


def test_neighbours_have_the_same_vertices_at_every_time() -> None:
    partition, rest = partition_of(SHAPES["ball"])
    regions = shatter(partition, rest, 3, [3, 4])
    surfaces = Surfaces(partition)
    first, second = (split.ids for split in partition.splits)
    # what the second split made was one piece before
    old = {n: [n] if n != second[0] else list(second) for n in first}
    meshes = [surfaces.mesh(held) for held in old.values()]
    meshes += [surfaces.mesh([n]) for n in second]
    meshes.append(surfaces.mesh(regions))
    for mesh in meshes:
        assert keys(mesh.vertices) <= keys(surfaces.vertices.numpy())
        assert np.array_equal(surfaces.vertices.numpy()[mesh.source], mesh.vertices)
    one = surfaces.mesh(old[first[1]])
    # each of its faces is on the skin of the whole, or turned around on a neighbour
    others = {
        tuple(mesh.source[face][::-1].tolist())
        for number, held in old.items()
        if number != first[1]
        for mesh in [surfaces.mesh(held)]
        for face in mesh.faces[~mesh.skin]
    }

    def turned(face: tuple[int, ...]) -> set[tuple[int, ...]]:
        return {face, face[1:] + face[:1], face[2:] + face[:2]}

    crack = [tuple(one.source[face].tolist()) for face in one.faces[~one.skin]]
    assert len(crack) > 100 and all(turned(face) & others for face in crack)


def test_an_edge_of_the_solid_stays_sharp() -> None:
    partition, rest = partition_of(SHAPES["cube"], EDGE / 10)
    shatter(partition, rest, 1, [2])
    surfaces = Surfaces(partition)
    whole = surfaces.mesh([0, 1])
    # along the rim where skin meets face normals are not blended
    mesh = surfaces.mesh([0])
    rim = np.intersect1d(mesh.faces[mesh.skin], mesh.faces[~mesh.skin])
    corners = mesh.corner_normals()
    for sheet in (mesh.skin, ~mesh.skin):
        found = mesh.vertices[mesh.faces[sheet]]
        flat = np.cross(found[:, 1] - found[:, 0], found[:, 2] - found[:, 0])
        area = np.linalg.norm(flat, axis=1)
        at_rim = np.isin(mesh.faces[sheet], rim) & (area > 0.1 * np.median(area))[:, None]
        cosine = np.einsum("fd,fkd->fk", flat / area.clip(1e-30)[:, None], corners[sheet])
        assert np.quantile(cosine[at_rim], 0.1) > 0.8
    low, high = whole.vertices.min(axis=0), whole.vertices.max(axis=0)
    assert np.abs(low + 0.5 * EDGE).max() < 0.5 * partition.voxel
    assert np.abs(high - 0.5 * EDGE).max() < 0.5 * partition.voxel


def test_vertices_and_their_differences_fit_in_single_precision() -> None:
    partition, rest = partition_of(SHAPES["ball"])
    shatter(partition, rest, 5, [4])
    surfaces = Surfaces(partition)
    whole = surfaces.vertices.numpy()
    middle = np.round(whole.mean(axis=0) / surfaces.step) * surfaces.step
    apart = (whole - middle).astype(np.float32)
    assert np.array_equal(apart.astype(np.float64) + middle, whole)
