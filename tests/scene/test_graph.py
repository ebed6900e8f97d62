"""Connected components against a union-find written out here."""

import numpy as np
from hypothesis import given, strategies as st

from jaxba.scene import components
from jaxba.scene._graph import component_labels, number_by_first


def groups_by_dictionary(edges: np.ndarray, count: int) -> set[frozenset[int]]:
    group = {node: frozenset([node]) for node in range(count)}
    for a, b in edges.tolist():
        merged = group[a] | group[b]
        for node in merged:
            group[node] = merged
    return set(group.values())


graphs = st.integers(1, 12).flatmap(
    lambda n: st.tuples(st.just(n), st.lists(st.tuples(st.integers(0, n - 1), st.integers(0, n - 1)), max_size=15))
)


@given(graphs)
def test_components_are_those_of_a_dictionary_union_find(graph):
    count, edges = graph
    edges = np.array(edges, int).reshape(-1, 2)
    found = components(edges, count)
    assert {frozenset(group) for group in found} == groups_by_dictionary(edges, count)
    assert sorted(node for group in found for node in group) == list(range(count))
    assert list(found) == sorted(found, key=lambda group: (-len(group), min(group)))
    assert all(group == tuple(sorted(group)) for group in found)


@given(graphs)
def test_labels_count_up_in_the_order_of_the_lowest_nodes(graph):
    count, edges = graph
    labels = component_labels(np.array(edges, int).reshape(-1, 2), count)
    first_seen = list(dict.fromkeys(labels.tolist()))
    assert first_seen == list(range(len(first_seen)))


def test_no_nodes_and_no_edges():
    assert components(np.zeros((0, 2), int), 0) == ()
    assert components(np.zeros((0, 2), int), 2) == ((0,), (1,))
    assert number_by_first(np.zeros(0, int)).shape == (0,)
