"""Rooms of views: clusters of views that see the same cells (seeds 2.4 to 2.6)."""

from __future__ import annotations

from dataclasses import replace

from topomerge.extraction.convolution import sphere
from topomerge.extraction.floor import Floor
from topomerge.extraction.parameters import ThesisParameters
from topomerge.extraction.stopwatch import Stopwatch
from topomerge.extraction.views.clustering import cluster_views
from topomerge.extraction.views.navigable_floor import navigable_floor
from topomerge.extraction.views.propagation import propagate_labels
from topomerge.extraction.views.room_pieces import split_rooms
from topomerge.extraction.views.similarity import jaccard_similarity
from topomerge.extraction.views.views import optimal_views
from topomerge.extraction.views.visibility import visible_cells
from topomerge.extraction.views.votes import vote
from topomerge.types import VoxelGrid


def rooms_of_views(grid: VoxelGrid, navigable: VoxelGrid, p: ThesisParameters, watch: Stopwatch) -> Floor:
    """The floor cut into rooms as the thesis does; the inflation that it chose is among the floor's parameters.

    Args:
        grid: occupied cells.
        navigable: the navigable volume.
        p: parameters of the thesis.
        watch: measures each step.
    """
    watch.begin("views", 0.4)
    views = optimal_views(navigable, p.view_radius, p.view_height)  # 2.4
    watch.begin("visibility", 0.45)
    visibility = visible_cells(grid, views, p.range, watch.part(0.45, 0.65))  # 2.5
    watch.begin("similarity", 0.65)
    similarity = jaccard_similarity(visibility, p.least_similarity, views, 2 * p.range, grid.cells[:, 2])  # 2.6
    watch.begin("clusters", 0.75)
    cluster, inflation = cluster_views(similarity, p.inflations)
    watch.begin("rooms", 0.85)
    labels = vote(visibility, cluster)
    labels = propagate_labels(grid, labels, sphere(p.propagation_cells, 1.0), p.propagation_rounds)
    room = split_rooms(grid, labels, p.least_volume)
    floor = navigable_floor(grid, room, navigable, p.standing_height, p.body_width)
    return replace(floor, chosen_parameters={"inflation": inflation})
