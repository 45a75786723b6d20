"""Values are evened within a material, and false metal is told from true metal beside it."""

import numpy as np
from scipy.sparse import coo_array, diags_array
from scipy.sparse.linalg import spsolve

from refdgs_pipe.texture.evening import evened
from refdgs_pipe.texture.false_metal import false_metal


def strip(count: int = 400) -> np.ndarray:
    """(E, 2) links of vertices in a row."""
    return np.stack([np.arange(count - 1), np.arange(1, count)], 1)


def test_values_are_even_where_colours_are_and_change_where_they_do() -> None:
    random = np.random.default_rng(5)
    left = np.arange(400) < 200
    values = np.where(left, 0.6, 0.1) + 0.1 * random.normal(size=400)
    colors = np.where(left[:, None], 0.5, 0.1) * np.ones((400, 3))
    told = evened(values.astype(np.float32), np.ones(400, np.float32), colors, strip(), 0.12)
    assert np.abs(told[:190] - 0.6).max() < 0.15 and np.abs(told[210:] - 0.1).max() < 0.15


def test_what_tells_little_takes_the_value_of_what_tells_much() -> None:
    values, evidence = np.full(400, 0.6, np.float32), np.ones(400, np.float32)
    values[150:170], evidence[150:170] = 0.0, 0.01
    told = evened(values, evidence, np.full((400, 3), 0.3, np.float32), strip(), 0.12)
    assert told.min() > 0.5


def two_parts() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(400,) the left part of a row, (400, 3) colours, and (400,) how much the views vary."""
    left = np.arange(400) < 200
    colors = np.where(left[:, None], 0.5, 0.1) * np.ones((400, 3))
    return left, colors, np.random.default_rng(2).uniform(0.5, 1.5, 400)


def test_a_print_beside_a_metal_does_not_make_it_plastic() -> None:
    left, colors, varied = two_parts()
    missed = varied * np.where(left, 0.6, 15.0)
    false = false_metal(np.ones(400, bool), missed, varied, colors, strip())
    assert not false[:195].any() and false[205:].all()


def test_a_metal_stays_whole_where_the_mesh_is_wrong_in_a_place() -> None:
    _, colors, varied = two_parts()
    missed = 0.6 * varied
    missed[62:66] *= 5
    assert not false_metal(np.ones(400, bool), missed, varied, colors, strip()).any()


def test_what_is_no_metal_is_not_judged_and_tells_nothing_of_its_neighbours() -> None:
    left, colors, varied = two_parts()
    missed = varied * np.where(left, 15.0, 0.6)
    false = false_metal(~left, missed, varied, np.full((400, 3), 0.3), strip())
    assert not false.any()
    assert not false_metal(np.zeros(400, bool), missed, varied, colors, strip()).any()


def test_a_metal_that_no_view_shows_does_not_disturb_the_others() -> None:
    left, colors, varied = two_parts()
    missed = varied * np.where(left, 0.6, 15.0)
    metal = np.ones(400, bool)
    metal[[100, 102]] = False
    missed[101] = varied[101] = 0.0  # alone, and not seen
    false = false_metal(metal, missed, varied, colors, strip())
    assert not false[:195].any() and false[205:].all()


def test_a_long_reach_is_solved_to_the_end() -> None:
    random, side = np.random.default_rng(3), 60
    index = np.arange(side * side).reshape(side, side)
    links = np.concatenate(
        [
            np.stack([a.ravel(), b.ravel()], 1)
            for a, b in ((index[1:], index[:-1]), (index[:, 1:], index[:, :-1]))
        ]
    )
    count, reach = side * side, 0.4
    values = random.normal(size=count).astype(np.float32)
    evidence = random.uniform(0.1, 2, count).astype(np.float32)
    found = evened(values, evidence, np.full((count, 3), 0.3), links, reach, 1e-6)
    weight = np.full(len(links), reach**2 * count * (1 + 1e-4))
    graph = coo_array((weight, tuple(links.T)), shape=(count, count)).tocsr()
    graph = graph + graph.T
    matrix = diags_array(evidence + graph.sum(1)) - graph
    true = spsolve(matrix.tocsc(), evidence * values)
    assert np.abs(found - true).max() < 1e-3
