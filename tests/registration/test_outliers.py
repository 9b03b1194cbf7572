"""Iterative removal: the very pairs of the plain loop, whatever the order, and a trace that can be redrawn."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from levkas.geometry.transforms import Affine, Polynomial, frame_of
from levkas.registration.outliers import RemovalTerms, clean, cut
from levkas.registration.record import RegistrationRefused

SIZE = (1392, 1040)
STILL = Affine.identity()


def plant(n, wrong, *, seed, noise=0.2, radius=100.0):
    """Return target, reference and the mask of wrong pairs: a bent map, noise, displaced pairs."""
    rng = np.random.default_rng(seed)
    target = rng.uniform(0, SIZE, (n, 2))
    u, v = ((target - np.array(SIZE) / 2) / 700).T
    bend = np.stack([3 * u**3 + 2 * v**2 + 5, 4 * v * u**2 - 3], 1)
    reference = target + bend + rng.normal(0, noise, (n, 2))
    bad = np.zeros(n, bool)
    bad[rng.choice(n, wrong, replace=False)] = True
    angle, reach = rng.uniform(0, 2 * np.pi, wrong), radius * rng.uniform(0.1, 0.95, wrong)
    reference[bad] += np.stack([np.cos(angle), np.sin(angle)], 1) * reach[:, None]
    return target, reference, bad


def plain_loop(target, reference, *, reject, stop, order=3):
    """Return (worst, largest) a round: every fit from scratch, as the paper says it."""
    kept = cut(target, reference, STILL, reject)[1]
    frame = frame_of(target[kept])
    rank = np.empty(len(target), int)
    rank[np.lexsort((*target.T[::-1], *reference.T[::-1]))] = np.arange(len(target))
    rounds = []
    while True:
        model = Polynomial.fit(target[kept], reference[kept], order=order, frame=frame)
        errors = np.where(kept, np.linalg.norm(model(target) - reference, axis=1), -1)
        equal = np.flatnonzero(errors >= errors.max() - 1e-9)
        worst = int(equal[rank[equal].argmin()])
        rounds.append((worst, errors[worst]))
        if errors[worst] <= stop:
            return rounds
        kept[worst] = False


def removed(target, reference, **options):
    terms = RemovalTerms(STILL, **options)
    return clean(target, reference, terms, size=SIZE, target_size=SIZE)


def near_ties(apart):
    """Return eighty pairs whose errors are equal, or all but equal, in a pattern of mirror images, among others."""
    target, reference, _ = plant(300, 0, seed=5, noise=0.05)
    reach = 30.0 + apart * np.random.default_rng(5).permutation(80)
    reference[:80, 0] += np.where(np.arange(80) % 2, 1.0, -1.0) * reach
    reference[:40] = np.round(reference[:40])
    return target, reference


def mirror_images():
    x, y = np.meshgrid(np.arange(-6.0, 7), np.arange(-6.0, 7))
    target = np.stack([x.ravel(), y.ravel()], 1) * 50
    reference = target.copy()
    reference[np.abs(target).min(1) == 300] *= 1.1
    return target, reference


def twice(pairs):
    return [np.repeat(part, 2, axis=0) for part in pairs]


@pytest.mark.parametrize(
    ("pairs", "options"),
    [
        (plant(400, 200, seed=1)[:2], {"order": 1}),
        (plant(400, 200, seed=4)[:2], {"order": 4}),
        (plant(1250, 1080, seed=7)[:2], {}),  # past a new factorisation
        (plant(120, 118, seed=3)[:2], {"stop": 0.5}),  # nearly all must leave
        (near_ties(0.0), {}),
        (near_ties(1e-7), {}),
        (mirror_images(), {"order": 1}),
        (twice(plant(100, 20, seed=9)[:2]), {}),
    ],
)
def test_the_same_pairs_leave_as_in_the_plain_loop(pairs, options):
    options = {"reject": 120.0, "stop": 1.0} | options
    copies = [part.copy() for part in pairs]
    trace = removed(*pairs, **options).trace
    plain = plain_loop(*pairs, **options)
    assert trace.removed.tolist() == [worst for worst, _ in plain[:-1]] + [-1]
    # Rounding of a thousand updates: a millionth of what separates two pairs here.
    np.testing.assert_allclose(trace.largest, [e for _, e in plain], atol=1e-8)
    for part, copy in zip(pairs, copies, strict=True):
        np.testing.assert_array_equal(part, copy)


@settings(max_examples=10, deadline=None)
@given(st.integers(0, 10_000))
def test_the_order_of_matches_does_not_matter(seed):
    target, reference, _ = plant(150, 60, seed=seed)
    order = np.random.default_rng(seed).permutation(150)
    one, two = (
        removed(target[k], reference[k], reject=110, stop=1).trace.removed
        for k in (np.arange(150), order)
    )
    assert order[two[:-1]].tolist() == one[:-1].tolist()


def test_trace_redraws_every_round():
    target, reference, _ = plant(200, 60, seed=2, radius=180)
    done = removed(target, reference, reject=108, stop=1)
    trace = done.trace
    assert trace.rounds == len(trace.corners) == len(trace.removed)
    assert trace.largest[-1] <= 1 < trace.largest[-2] and trace.removed[-1] == -1
    for number in (0, trace.rounds // 2, trace.rounds - 1):
        kept = trace.kept_at(number)
        model = Polynomial.fit(target[kept], reference[kept])
        corners = np.array([[-0.5, -0.5], [1391.5, -0.5], [1391.5, 1039.5], [-0.5, 1039.5]])
        np.testing.assert_allclose(trace.corners[number], model(corners), atol=1e-6)
        errors = np.linalg.norm(model(target[kept]) - reference[kept], axis=1)
        assert trace.largest[number] == pytest.approx(errors.max(), abs=1e-8)
    assert (done.round == 0).sum() == (trace.scale_errors >= 108).sum() > 0
    assert sorted(done.round[done.round > 0]) == list(range(1, trace.rounds))
    assert trace.to_dict()["rounds"] == trace.rounds


def test_leave_one_out_is_the_error_of_a_fit_without_the_pair():
    target, reference, _ = plant(60, 10, seed=4)
    done = removed(target, reference, reject=108, stop=1)
    k = int(np.flatnonzero(done.kept)[5])
    others = done.kept.copy()
    others[k] = False
    model = Polynomial.fit(target[others], reference[others])
    error = np.linalg.norm(model(target[[k]]) - reference[[k]])
    assert done.leave_one_out[k] == pytest.approx(error, abs=1e-9)


def test_too_few_matches_are_refused_with_the_trace():
    target, reference, _ = plant(9, 0, seed=0)
    with pytest.raises(RegistrationRefused) as refusal:
        removed(target, reference, reject=108, stop=1)
    assert refusal.value.problems[0].code == "E_MATCHES"
    assert refusal.value.trace.rounds == 0


def test_matches_on_a_line_are_refused():
    target = np.stack([np.linspace(0, 900, 40), np.linspace(0, 300, 40)], 1)
    with pytest.raises(RegistrationRefused) as refusal:
        removed(target, target + 1, reject=108, stop=1)
    assert refusal.value.problems[0].code == "E_MATCHES"


@pytest.mark.parametrize(
    ("name", "bad"),
    [("reject", 0), ("stop", float("nan")), ("stop", "3"), ("reject", True), ("reject", 0.5)],
)
def test_thresholds_that_are_no_positive_numbers_are_refused(name, bad):
    with pytest.raises(RegistrationRefused) as refusal:
        RemovalTerms(STILL, **({"reject": 108.0, "stop": 1.0} | {name: bad}))
    assert refusal.value.problems[0].field == f"registration.{name}"
