import numpy as np
from scipy.optimize import minimize

from lfd.planning.batched_descent import minimise

FREE = np.full(3, np.inf)


def test_a_quadratic_in_its_own_metric_takes_one_step(rng: np.random.Generator) -> None:
    root = rng.standard_normal((5, 5))
    hessian, wanted = root @ root.T + np.eye(5), rng.standard_normal((4, 5, 3))

    def quadratic(x: np.ndarray, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        pull = hessian @ (x - wanted[rows])
        return 0.5 * np.einsum("btd,btd->b", x - wanted[rows], pull), pull

    found = minimise(
        quadratic,
        np.zeros((4, 5, 3)),
        low=-FREE,
        high=FREE,
        inverse_metric=np.linalg.inv(hessian),
        longest=np.inf,
        tolerance=1e-12,
        evaluations=100,
    )
    assert found.converged.all()
    assert found.evaluations == 2
    np.testing.assert_allclose(found.x, wanted, atol=1e-10)


def test_bounds_hold_and_the_minimum_within_them_is_scipys(rng: np.random.Generator) -> None:
    root = rng.standard_normal((12, 12))
    hessian, pull = root @ root.T + 0.1 * np.eye(12), 3.0 * rng.standard_normal((6, 12))
    low, high = np.array([-0.3, -1.0, -np.inf]), np.array([0.3, 0.5, np.inf])

    def bent(x: np.ndarray, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        flat = x.reshape(len(x), 12)
        value = 0.5 * np.einsum("bi,ij,bj->b", flat, hessian, flat) - (flat * pull[rows]).sum(axis=1)
        gradient = flat @ hessian - pull[rows] + flat**3
        return value + 0.25 * (flat**4).sum(axis=1), gradient.reshape(x.shape)

    found = minimise(
        bent,
        np.zeros((6, 4, 3)),
        low=low,
        high=high,
        inverse_metric=np.eye(4),
        longest=1.0,
        tolerance=1e-12,
        evaluations=2000,
    )
    assert found.converged.all()
    assert ((low <= found.x) & (found.x <= high)).all()
    assert (found.x[..., 0] == 0.3).any()
    for row in range(6):

        def one(flat: np.ndarray, row: int = row) -> tuple[float, np.ndarray]:
            value, gradient = bent(flat.reshape(1, 4, 3), np.array([row]))
            return value[0], gradient.ravel()

        bounds = list(zip(np.tile(low, 4), np.tile(high, 4), strict=True))
        best = minimize(
            one, np.zeros(12), jac=True, method="L-BFGS-B", bounds=bounds, options={"ftol": 1e-15, "gtol": 1e-10}
        )
        np.testing.assert_allclose(found.value[row], best.fun, rtol=1e-9)


def test_rosenbrocks_valley_is_followed_to_its_end() -> None:
    def valley(x: np.ndarray, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        u, v = x[:, 0, 0], x[:, 1, 0]
        gradient = np.stack([-2 * (1 - u) - 400 * u * (v - u**2), 200 * (v - u**2)], axis=1)
        return (1 - u) ** 2 + 100 * (v - u**2) ** 2, gradient[:, :, None]

    starts = np.array([[-1.2, 1.0], [2.0, -1.0], [0.0, 3.0]])[:, :, None]
    found = minimise(
        valley,
        starts,
        low=np.array([-5.0]),
        high=np.array([5.0]),
        inverse_metric=np.eye(2),
        longest=1.0,
        tolerance=1e-14,
        evaluations=500,
    )
    assert found.converged.all()
    np.testing.assert_allclose(found.x, 1.0, atol=1e-5)


def test_rows_do_not_depend_on_each_other() -> None:
    def wave(x: np.ndarray, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return np.sin(x).sum(axis=(1, 2)), np.cos(x)

    starts = np.linspace(0, 6, 15).reshape(5, 3, 1)
    options = {"low": np.array([-9.0]), "high": np.array([9.0]), "inverse_metric": np.eye(3), "longest": 0.7}
    together = minimise(wave, starts, **options, tolerance=1e-10, evaluations=100)
    alone = [minimise(wave, start[None], **options, tolerance=1e-10, evaluations=100).x[0] for start in starts]
    np.testing.assert_array_equal(together.x, alone)


def test_running_out_of_evaluations_is_said() -> None:
    def slow(x: np.ndarray, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return (x**4).sum(axis=(1, 2)), 4 * x**3

    found = minimise(
        slow,
        np.ones((1, 1, 1)),
        low=np.array([-2.0]),
        high=np.array([2.0]),
        inverse_metric=np.eye(1),
        longest=0.1,
        tolerance=1e-15,
        evaluations=3,
    )
    assert not found.converged[0]
