import pytest
import torch

from gsfusion_nb.tsdf import morton
from gsfusion_nb.tsdf.octree import BlockIndex


def insert(index, coords):
    """Rows of the blocks, those not yet allocated included."""
    index.add(index.missing(coords))
    return index.find(coords)


def test_insert_and_find():
    index = BlockIndex()
    assert index.find(torch.tensor([[0, 0, 0]])).tolist() == [-1]
    rows = insert(
        index,
        torch.tensor([[1, 0, 0], [0, 0, 0], [1, 0, 0]]),
    )
    assert rows.tolist() == [1, 0, 1]  # Morton order decides, duplicates share
    assert insert(
        index,
        torch.tensor([[-5, 2, 9], [0, 0, 0]]),
    ).tolist() == [2, 0]
    assert index.find(
        torch.tensor([[0, 0, 0], [-5, 2, 9], [1, 0, 0], [0, 1, 0], [500, 0, 0]])
    ).tolist() == [
        0,
        2,
        1,
        -1,
        -1,
    ]
    assert bool((index.codes.diff() > 0).all())
    assert len(index) == 3


def test_against_a_dictionary(generator):
    index = BlockIndex()
    expected = {}
    for spread in (3, 6, 40, 10):
        coords = torch.randint(-spread, spread, (200, 3), generator=generator)
        rows = insert(index, coords)
        for c, r in zip(coords.tolist(), rows.tolist(), strict=True):
            assert expected.setdefault(tuple(c), r) == r
    assert sorted(expected.values()) == list(range(len(index)))
    query = torch.randint(-45, 45, (3000, 3), generator=generator)
    query = torch.cat([query, torch.tensor(list(expected))])
    assert index.find(query).tolist() == [expected.get(tuple(c), -1) for c in query.tolist()]


def test_missing_blocks_are_new_sorted_and_different(generator):
    index = BlockIndex()
    edge = morton.OFFSET
    insert(index, torch.randint(-9, 9, (300, 3), generator=generator))
    # old and new ones, and some twice
    coords = torch.randint(-12, 12, (500, 3), generator=generator)
    coords = torch.cat([coords, torch.tensor([[edge - 1] * 3, [-edge] * 3])])
    for given in (coords, coords.to(torch.int32), coords[:0]):
        new = index.missing(given)
        before = len(index)
        wanted = {
            tuple(c)
            for c, row in zip(
                given.tolist(),
                index.find(given).tolist(),
                strict=True,
            )
            if row < 0
        }
        assert sorted(map(tuple, new.coords.tolist())) == sorted(wanted)
        assert len(new) == len(wanted)
        assert torch.equal(new.codes, morton.encode(new.coords))
        assert bool((new.codes.diff() > 0).all())
        assert new.contains(given).tolist() == [tuple(c) in wanted for c in given.tolist()]
        assert len(index) == before
    new = index.missing(coords)
    index.add(new)
    assert index.find(new.coords).tolist() == list(range(before, before + len(new)))
    assert len(index.missing(coords)) == 0
    assert not index.missing(coords).contains(coords).any()
    with pytest.raises(ValueError, match=r"must lie in \[-1048576, 1048576\), got -1048577 to 9"):
        index.missing(torch.tensor([[9, 9, 9], [0, 0, -edge - 1]]))


def test_a_table_grows_as_if_it_had_been_made_at_once(generator):
    grown = BlockIndex()
    for size in (2, 3, 20, 21, 400, 4000):
        coords = torch.randint(-size, size, (200, 3), generator=generator)
        insert(grown, coords)
        at_once = BlockIndex.of_blocks(morton.decode(grown.codes))
        query = torch.cat(
            [torch.randint(-60, 60, (3000, 3), generator=generator), coords, coords + 1]
        )
        assert torch.equal(
            grown.rows[at_once.find(query)].where(at_once.find(query) >= 0, -1),
            grown.find(query),
        )
        assert torch.equal(grown.find(query), grown._search(morton.encode(query)))


@pytest.mark.parametrize("far", [[3000, -1500, 12], [3000, 0, 0]])
def test_a_far_block_costs_one_node(far, generator):
    coords = torch.randint(-20, 20, (300, 3), generator=generator)
    near = BlockIndex()
    both = BlockIndex()
    insert(near, coords)
    insert(both, coords)
    assert insert(both, torch.tensor([far])).tolist() == [len(near)]
    assert both.table is not None
    assert near.table is not None
    assert int((both.table.nodes > 0).sum()) == int((near.table.nodes > 0).sum()) + 1
    query = torch.randint(-25, 25, (2000, 3), generator=generator)
    assert torch.equal(near.find(query), both.find(query))


def test_a_map_far_from_the_origin_has_a_small_table():
    index = BlockIndex()
    insert(
        index,
        torch.tensor([[1_000_000, -1_000_000, 12], [1_000_001, -1_000_000, 12]]),
    )
    assert index.table is not None
    assert index.table.nodes.numel() < 100


def test_a_map_too_large_for_a_table_is_searched_by_code_and_says_so(generator, caplog):
    coords = torch.cat(
        [
            torch.randint(-20, 20, (300, 3), generator=generator),
            torch.tensor([[1_000_000, -1_000_000, 12]]),
        ]
    )
    index = BlockIndex()
    rows = insert(index, coords)
    assert index.table is None
    assert len(caplog.records) == 1
    insert(index, coords + 1)
    assert len(caplog.records) == 1
    assert torch.equal(index.find(coords), rows)


def test_levels(generator):
    index = BlockIndex()
    coords = torch.randint(-9, 9, (100, 3), generator=generator)
    insert(index, coords)
    assert index.level(1).tolist() == (morton.encode(coords) >> 3).unique().tolist()
    assert index.level(morton.BITS).tolist() == [0]
    with pytest.raises(ValueError, match="level"):
        index.level(22)


def test_rows_of_given_blocks(generator):
    coords = torch.randint(-9, 9, (50, 3), generator=generator).unique(dim=0)
    coords = coords[torch.randperm(coords.shape[0], generator=generator)]
    assert BlockIndex.of_blocks(coords).find(coords).tolist() == list(range(coords.shape[0]))
    assert len(BlockIndex.of_blocks(coords[:0])) == 0


def test_by_hand():
    o = morton.OFFSET
    coords = torch.tensor([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1], [5, 3, 6]]) - o
    # 5 = 101, 3 = 011, 6 = 110 -> bits (z y x) from the top: 1 0 1, 1 1 0, 0 1 1 -> 0b101110011
    assert morton.encode(coords).tolist() == [0, 1, 2, 4, 0b101110011]


def test_round_trip(generator):
    edge = morton.OFFSET
    coords = torch.randint(-edge, edge, (5000, 3), generator=generator)
    coords = torch.cat([coords, torch.tensor([[-edge] * 3, [edge - 1] * 3, [0, -1, 1]])])
    codes = morton.encode(coords)
    assert bool((codes >= 0).all())
    assert torch.equal(morton.decode(codes), coords)
    assert morton.decode(morton.encode(coords.to(torch.int32))).dtype == torch.int64


def test_refuses_what_does_not_fit():
    with pytest.raises(ValueError, match=r"must lie in \[-1048576, 1048576\), got 0 to 1048576"):
        morton.encode(torch.tensor([[0, 0, morton.OFFSET]]))
    assert morton.encode(torch.zeros(0, 3, dtype=torch.int64)).shape == (0,)


def test_parent_holds_its_eight_children():
    block = torch.tensor([[-3, 4, 7]])
    children = torch.tensor([[2 * -3 + (c & 1), 8 + (c >> 1 & 1), 14 + (c >> 2)] for c in range(8)])
    parents = morton.encode(children) >> 3
    # One level up, coordinates and their offset are halved.
    expected = morton.encode(block + morton.OFFSET // 2 - morton.OFFSET)
    assert parents.tolist() == expected.expand(8).tolist()
    assert (morton.encode(children) & 7).tolist() == list(range(8))
