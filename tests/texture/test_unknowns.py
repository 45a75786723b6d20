"""What the fit of material and light holds against its unknowns."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from refdgs_pipe.texture.unknowns import State, Unknown

HEIGHT, COUNT = 8, 4
LINKS = torch.tensor([[0, 1], [1, 2], [2, 3]])
LIGHT = np.tile(np.array([0.9, 0.5, 0.3], np.float32), (2 * HEIGHT * HEIGHT, 1))


def state() -> State:
    """Four vertices in reddish light."""
    one, three = np.full(COUNT, 0.5, np.float32), np.full((COUNT, 3), 0.5, np.float32)
    return State(LIGHT, one, one, three, three, three)


def held(some: State, *, balanced: bool) -> float:
    return float(Unknown(some, balanced=balanced).roughening(LINKS, HEIGHT).detach())


def test_coloured_light_costs_only_where_cameras_balance_it() -> None:
    grey = replace(state(), light=np.full_like(LIGHT, 0.5))
    assert held(state(), balanced=True) > held(state(), balanced=False) + 1e-3
    assert held(grey, balanced=True) == pytest.approx(held(grey, balanced=False), abs=1e-7)


def test_known_light_may_have_any_colour() -> None:
    known = np.arange(len(LIGHT)) < len(LIGHT) // 2
    light = np.where(known[:, None], LIGHT, 0.5).astype(np.float32)
    some = replace(state(), light=light, known=known)
    assert held(some, balanced=True) == pytest.approx(held(some, balanced=False), abs=1e-7)
    beyond = Unknown(some, balanced=True).beyond().detach().numpy()
    assert not beyond[known].any()
    assert np.allclose(beyond[~known], 0.5)


def test_a_tint_that_leaves_what_was_told_costs() -> None:
    told = replace(state(), told_tint=np.full((COUNT, 3), 0.5, np.float32))
    apart = replace(state(), told_tint=np.full((COUNT, 3), 0.9, np.float32))
    assert held(told, balanced=False) == pytest.approx(held(state(), balanced=False), abs=1e-7)
    assert held(apart, balanced=False) > held(told, balanced=False) + 1e-3
