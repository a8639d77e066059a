"""Names that occur, and the building that each is of."""

from __future__ import annotations

from collections import Counter

import pytest
from topomerge.datasets.core.building import find_physical_building, parse_storey_name
from topomerge.datasets.plans import splits

HOTEL = "rmf_demos_maps/maps/hotel/"


@pytest.mark.parametrize(
    ("source", "names"),
    [
        ("rmf", [f"{HOTEL}L1", f"{HOTEL}L2", f"{HOTEL}L3", f"{HOTEL}L1 + {HOTEL}L2", f"{HOTEL}L2 + {HOTEL}L3"]),
        ("campus", ["school/Sabadell1", "school/Sabadell2", "school/Sabadell3", "school/Sabadell1 + school/Sabadell2"]),
        ("campus", ["school/RomainRolland1", "school/RomainRoland2"]),
        ("campus", ["school/rockislandgroundfloor", "school/rockislandsecondfloor"]),
        ("campus", ["school/Valleceppi_P0", "school/Valleceppi_P1"]),
        ("campus", ["office/floorplanLOWER", "office/floorplanMAIN"]),
        ("mall", ["data/site2/B1", "data/site2/F1", "data/site2/F8"]),
        ("procedural", ["hotel-994098-2", "hotel-994098-1", "hotel-994098"]),
        ("r2v", ["00/00/abc/0001", "00/00/abc/0002"]),
        ("utexas", ["gdc", "1", "1n", "3ne", "gdc1-lines", "GDC7/GDC7"]),
        ("halmstad", ["HIH", "HIH_01-HIH_02", "HIH_layout"]),
        ("ipa", ["lab_a_scan", "lab_a_scan_furnitures", "lab_a_scan_furnitures_trashbins", "lab_a_scan_gt_segmentation"]),
        ("carmen", ["freiburg-101", "freiburg-101-corrected", "freiburg-101-first-middle"]),
        ("carmen", ["orebro", "orebro-first-last", "orebro-corrected"]),
        ("strands", ["tsc", "tsc-2015-2016", "tsc20160523", "tsc_1701"]),
        ("ifc", ["duplex"]),
    ],
)
def test_names_of_one_building(source, names) -> None:
    assert len({find_physical_building(source, name) for name in names}) == 1


@pytest.mark.parametrize(
    ("source", "names"),
    [
        ("rmf", [f"{HOTEL}L1", "rmf_demos_maps/maps/clinic/L1", "rmf_demos_maps/maps/office/L1"]),
        (
            "campus",
            ["school/Franch1", "school/Sabadell1", "office/ED21", "school/scuolasconosciuta", "school/scuolasconosciuta2"],
        ),
        ("mall", ["data/site1/F1", "data/site2/F1"]),
        ("procedural", ["hotel-994098-2", "hotel-994099-2", "office-994098-2", "shifted-row-900001", "shifted-row-900002"]),
        ("r2v", ["00/00/abc/0001", "00/00/abd/0001"]),
        ("halmstad", ["HIH", "KPT4A", "F5"]),
        ("ipa", ["lab_a_scan", "lab_b_scan", "lab_ipa", "Freiburg101_scan", "Freiburg52_scan"]),
        ("carmen", ["orebro", "csail", "seattle", "infinite-corridor", "freiburg-101"]),
        ("utexas", ["gdc", "AHG1/AHG1", "ASE4/ASE4"]),
    ],
)
def test_names_of_as_many_buildings(source, names) -> None:
    assert len({find_physical_building(source, name) for name in names}) == len(names)


def test_one_building_of_two_owners() -> None:
    assert find_physical_building("ipa", "Freiburg101_scan_furnitures") == find_physical_building("carmen", "freiburg-101")
    assert find_physical_building("ipa-plan", "Freiburg101_scan") == find_physical_building("ipa", "Freiburg101_scan")
    assert find_physical_building("gdc", "3") == find_physical_building("utexas", "gdc")


def test_of_two_buildings_the_first() -> None:
    assert find_physical_building("procedural", "office-3-1 + office-5-1") == find_physical_building("procedural", "office-3-1")


def test_the_lists_of_the_splits_part_no_building() -> None:
    buildings = Counter()
    for split in splits.SPLITS:
        named = [(s, n) for s in splits.FOLDERS for n in splits.list_members(split, s)]
        assert named
        buildings.update({find_physical_building(*n) for n in named})
    assert max(buildings.values()) == 1


def test_storeys_by_name() -> None:
    assert parse_storey_name("Sabadell2") == ("sabadell", 2)
    assert parse_storey_name("B1") == ("", -1)
    assert parse_storey_name("3ne") == ("", 3.5)
    assert parse_storey_name("bluefieldschoolfirstfloor") == ("bluefieldschool", 1)
    assert parse_storey_name("herndon") == ("herndon", 0)
