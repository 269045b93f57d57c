"""Guesses from earlier solutions: exact where they can be, never wrong, and fewer iterations."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import sparse

from thermoxels_ns.fem.initial_guess import InitialGuess
from thermoxels_ns.fem.linear_solver import ConjugateGradients


@pytest.fixture
def matrix() -> sparse.csr_matrix:
    off = -np.ones(299)
    return sparse.diags([off, np.full(300, 2.01), off], [-1, 0, 1], format="csr")


def guessed(guess: InitialGuess, right_hand_side: np.ndarray) -> np.ndarray:
    found = guess.for_right_hand_side(right_hand_side)
    assert found is not None
    return found


def test_a_combination_of_what_was_solved_is_found(matrix) -> None:
    solutions = np.random.default_rng(0).normal(size=(3, 300))
    guess = InitialGuess()
    for x in solutions:
        guess.keep(matrix @ x, x)
    wanted = np.array([2.0, -1.0, 1e-3]) @ solutions
    np.testing.assert_allclose(guessed(guess, matrix @ wanted), wanted, atol=1e-9)


def test_the_oldest_is_forgotten_and_the_same_twice_does_no_harm(matrix) -> None:
    first, second = np.random.default_rng(1).normal(size=(2, 300))
    guess = InitialGuess()
    for x in (first, second, second, 1e-200 * second):
        guess.keep(matrix @ x, x)
    np.testing.assert_allclose(guessed(guess, matrix @ second), second, atol=1e-9)
    found = guessed(guess, matrix @ first)
    assert np.abs(found - first).max() > 1.0


def test_it_is_nearest_in_the_norm_of_the_matrix(matrix) -> None:
    rng = np.random.default_rng(2)
    known, wanted = rng.normal(size=(2, 300)), rng.normal(size=300)
    guess = InitialGuess()
    for x in known:
        guess.keep(matrix @ x, x)
    lacking = matrix @ (wanted - guessed(guess, matrix @ wanted))
    np.testing.assert_allclose(known @ lacking, 0.0, atol=1e-10)


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_what_is_not_finite_is_not_guessed_from(matrix, bad) -> None:
    guess = InitialGuess()
    guess.keep(np.ones(300), np.full(300, bad))
    assert guess.for_right_hand_side(np.ones(300)) is None
    guess.keep(matrix @ np.ones(300), np.ones(300))
    assert guess.for_right_hand_side(np.full(300, bad)) is None


def test_short_solutions_need_none(matrix) -> None:
    guess = InitialGuess()
    guess.keep(matrix @ np.ones(300), np.ones(300))
    guess.keep(np.ones(300), np.ones(300), iterations=3)
    assert guess.for_right_hand_side(np.ones(300)) is None


@pytest.mark.parametrize("tolerance", [1e-6, 1e-12])
def test_a_start_changes_the_iterations_and_not_the_tolerance(matrix, tolerance) -> None:
    b = np.random.default_rng(3).normal(size=300)
    solver = ConjugateGradients(matrix, relative_tolerance=tolerance)
    plain = solver.solve(b)
    near = solver.solve(b, plain.x + 1e-4 * np.abs(plain.x).max() * np.sin(np.arange(300.0)))
    assert near.converged and near.iterations < 0.8 * plain.iterations
    assert np.linalg.norm(b - matrix @ near.x) <= 2.0 * tolerance * np.linalg.norm(b)
    far = solver.solve(b, 1e6 * np.ones(300))
    assert far.iterations == plain.iterations
    np.testing.assert_array_equal(far.x, plain.x)
