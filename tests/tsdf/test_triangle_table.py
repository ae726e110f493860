from collections import Counter

import torch

from gsfusion_nb.tsdf.triangle_table import EDGES, loops, triangle_table


def inside(case, corner):
    return bool(case >> corner & 1)


def test_one_corner_by_hand():
    table, count = triangle_table()
    assert count[0] == count[255] == 0
    assert count[1] == count[254] == 1
    # Corner 0 inside: the triangle joins the x, y and z edges at it, counter-clockwise seen from (1, 1, 1).
    x, y, z = EDGES.index((0, 0)), EDGES.index((1, 0)), EDGES.index((2, 0))
    assert table[1, 0].tolist() in ([x, y, z], [y, z, x], [z, x, y])
    assert table[254, 0].tolist() in ([x, z, y], [z, y, x], [y, x, z])


def test_triangles_use_every_cut_edge_and_no_other():
    table, count = triangle_table()
    assert table.shape == (256, 5, 3)
    for case in range(256):
        cut = {e for e, (axis, low) in enumerate(EDGES) if inside(case, low) != inside(case, low | 1 << axis)}
        assert set(table[case, : count[case]].flatten().tolist()) == cut
        assert {e for loop in loops(case) for e in loop} == cut


def test_open_border_lies_in_the_faces_and_nothing_else_does():
    """Sides used once bound the patch and lie in cube faces; sides used twice run through the interior only."""
    table, count = triangle_table()
    corners = [{low, low | 1 << axis} for axis, low in EDGES]
    faces = [{c for c in range(8) if (c >> a & 1) == s} for a in range(3) for s in (0, 1)]
    for case in range(256):
        sides = Counter()
        for t in table[case, : count[case]].tolist():
            sides.update((t[i], t[(i + 1) % 3]) for i in range(3))
        assert max(sides.values(), default=1) == 1  # a directed side belongs to one triangle
        for a, b in sides:
            in_face = any(corners[a] <= face and corners[b] <= face for face in faces)
            assert in_face == ((b, a) not in sides)


def test_neighbouring_cubes_agree_on_their_face():
    """Directed sides in the shared face run in opposite directions, whatever the other corners are."""
    table, count = triangle_table()

    def border(case, axis, side):
        face = {c for c in range(8) if (c >> axis & 1) == side}
        found = set()
        for t in table[case, : count[case]].tolist():
            for a, b in ((t[0], t[1]), (t[1], t[2]), (t[2], t[0])):
                ends = [{EDGES[e][1], EDGES[e][1] | 1 << EDGES[e][0]} for e in (a, b)]
                if ends[0] <= face and ends[1] <= face:
                    # drop the coordinate across the face, so that both cubes name the edge alike
                    found.add(tuple((EDGES[e][0], EDGES[e][1] & ~(1 << axis)) for e in (a, b)))
        return found

    generator = torch.Generator().manual_seed(0)
    for axis in range(3):
        low_corners = [c for c in range(8) if not c >> axis & 1]
        for pattern in range(16):
            bits = [(c, pattern >> i & 1) for i, c in enumerate(low_corners)]
            for _ in range(4):
                left, right = torch.randint(0, 256, (2,), generator=generator).tolist()
                for c, bit in bits:
                    high = c | 1 << axis
                    left = left & ~(1 << high) | bit << high
                    right = right & ~(1 << c) | bit << c
                assert border(left, axis, 1) == {(b, a) for a, b in border(right, axis, 0)}
