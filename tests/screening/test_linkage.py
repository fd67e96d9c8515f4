"""The graph of overlaps against graphs whose structure is known by construction."""

from stitch.screening.linkage import Link, linkage_of_links


def links(*pairs, share=1.0, count=100):
    return [Link(v, w, count, share) for v, w in pairs]


def test_a_chain_is_one_component_and_its_ends_hang_by_one_pair():
    found = linkage_of_links(5, links((0, 1), (1, 2), (2, 3), (3, 4)))
    assert found.components == ((0, 1, 2, 3, 4),)
    assert found.single == ((0, 1), (4, 3))


def test_in_a_ring_nothing_hangs_by_one_pair():
    found = linkage_of_links(6, links(*((v, (v + 1) % 6) for v in range(6))))
    assert (found.single, found.unlinked) == ((), ())


def test_two_rings_are_two_groups():
    found = linkage_of_links(7, links((0, 1), (1, 2), (2, 0), (3, 4), (4, 5), (5, 6), (6, 3)))
    assert found.components == ((3, 4, 5, 6), (0, 1, 2))


def test_pairs_that_lie_near_without_closing_link_nothing():
    found = linkage_of_links(3, [*links((0, 1)), *links((1, 2), share=0.2)])
    assert found.unlinked == (2,)
    assert linkage_of_links(3, [*links((0, 1)), *links((1, 2), count=5)]).unlinked == (2,)


def test_a_view_without_any_pair_is_unlinked_and_not_a_group():
    found = linkage_of_links(3, links((0, 1)))
    assert found.unlinked == (2,)
