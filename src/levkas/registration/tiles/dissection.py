"""Sparse normal equations of many tiles: Cholesky by nested dissection, solutions and covariances.

Every tile has a block of unknowns, overlaps couple two blocks, and a few unknowns are shared by all. Tiles lie on a plane, so that
a line of tiles separates those on either side of it: the two sides are eliminated before the line, each again in the same way
([george1973]_). Fronts are dense and small: of 30,000 tiles the last has some 1,400 unknowns.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import solve_triangular

#: Tiles that are eliminated together without being separated further.
LEAF = 12


@dataclass(frozen=True)
class BlockSystem:
    """Symmetric positive definite matrix of blocks.

    Parameters
    ----------
    pairs : ndarray of int, (m, 2)
        Tiles whose blocks are coupled, each pair once.
    diagonal : ndarray, (n, d, d)
    coupling : ndarray, (m, d, d)
        Rows of the first tile of a pair, columns of the second.
    border : ndarray, (n, d, s)
        Rows of a tile, columns of the shared unknowns.
    corner : ndarray, (s, s)
        Of the shared unknowns.
    """

    pairs: np.ndarray
    diagonal: np.ndarray
    coupling: np.ndarray
    border: np.ndarray
    corner: np.ndarray


@dataclass(frozen=True)
class Elimination:
    """Order in which tiles are eliminated: fronts, children before parents.

    Parameters
    ----------
    own : list of ndarray of int
        Tiles that a front eliminates.
    beyond : list of ndarray of int
        Tiles eliminated later that it touches.
    parent : ndarray of int, (fronts,)
        Front that takes its Schur complement; −1 of the last ones.
    """

    own: list[np.ndarray]
    beyond: list[np.ndarray]
    parent: np.ndarray

    @classmethod
    def of_plane(cls, places: np.ndarray, pairs: np.ndarray) -> Elimination:
        """Return the order by nested dissection of tiles at `places`, (n, 2), coupled in `pairs`, (m, 2).

        >>> order = Elimination.of_plane(np.array([[0.0, 0], [1, 0]]), np.array([[0, 1]]))
        >>> [front.tolist() for front in order.own]
        [[0, 1]]
        """
        count = len(places)
        near = _neighbours(count, pairs)
        own, parent = _dissect(places, near)
        front = np.empty(count, int)
        for number, tiles in enumerate(own):
            front[tiles] = number
        beyond: list[set[int]] = [set() for _ in own]
        for number, tiles in enumerate(own):
            for tile in tiles:
                beyond[number].update(n for n in near[tile] if front[n] > number)
            if parent[number] >= 0:
                mine = set(own[parent[number]].tolist())
                beyond[parent[number]] |= beyond[number] - mine
        return cls(own, [np.array(sorted(b), int) for b in beyond], parent)


def _neighbours(count: int, pairs: np.ndarray) -> list[np.ndarray]:
    both = np.concatenate([pairs, pairs[:, ::-1]]).reshape(-1, 2)
    both = both[np.lexsort((both[:, 1], both[:, 0]))]
    return np.split(both[:, 1], np.searchsorted(both[:, 0], np.arange(1, count)))


def _dissect(places: np.ndarray, near: list[np.ndarray]) -> tuple[list[np.ndarray], np.ndarray]:
    """Return fronts, children first, and the parent of each."""
    own: list[np.ndarray] = []
    parent: list[int] = []
    side = np.zeros(len(places), int)

    def split(tiles: np.ndarray) -> list[int]:
        """Add the fronts of `tiles`; return those without a parent."""
        if not len(tiles):
            return []
        if len(tiles) <= LEAF:
            own.append(tiles)
            parent.append(-1)
            return [len(own) - 1]
        axis = int(np.argmax(np.ptp(places[tiles], axis=0)))
        order = tiles[np.lexsort((tiles, places[tiles, axis]))]
        left, right = order[: len(order) // 2], order[len(order) // 2 :]
        side[left], side[right] = 1, 2
        apart = np.array([bool((side[near[t]] == 2).any()) for t in left])
        side[tiles] = 0
        children = split(np.sort(left[~apart])) + split(np.sort(right))
        if not apart.any():
            return children
        own.append(np.sort(left[apart]))
        parent.append(-1)
        for child in children:
            parent[child] = len(own) - 1
        return [len(own) - 1]

    split(np.arange(len(places)))
    return own, np.array(parent, int)


class BlockFactor:
    """Cholesky factor of a `BlockSystem`.

    Parameters
    ----------
    system : BlockSystem
    order : Elimination

    Raises
    ------
    numpy.linalg.LinAlgError
        Where the matrix is not positive definite.

    Examples
    --------
    Two tiles with one unknown each and a shared one:

    >>> pairs, one = np.array([[0, 1]]), np.ones((2, 1, 1))
    >>> system = BlockSystem(pairs, 4 * one, one[:1], 0 * one, np.eye(1))
    >>> factor = BlockFactor(system, Elimination.of_plane(np.zeros((2, 2)), pairs))
    >>> [part.round(12).tolist() for part in factor.solve(np.array([[5.0], [5.0]]), np.array([2.0]))]
    [[[1.0], [1.0]], [2.0]]
    >>> factor.covariances()[0].round(4).ravel().tolist()
    [0.2667, 0.2667]
    """

    def __init__(self, system: BlockSystem, order: Elimination) -> None:
        self._order, (self._count, self._d) = order, system.diagonal.shape[:2]
        self._s = len(system.corner)
        self._fronts: list[tuple[np.ndarray, np.ndarray]] = []
        front = np.empty(self._count, int)
        for number, tiles in enumerate(order.own):
            front[tiles] = number
        first = front[system.pairs].min(1) if len(system.pairs) else np.empty(0, int)
        by_front = np.argsort(first, kind="stable")
        starts = np.searchsorted(first[by_front], np.arange(len(order.own) + 1))
        waiting: dict[int, list[tuple[np.ndarray, np.ndarray]]] = {}
        corner = system.corner.copy()
        for number in range(len(order.own)):
            mine = by_front[starts[number] : starts[number + 1]]
            matrix = self._assembled(system, number, mine, waiting.pop(number, []))
            rest = self._eliminate(matrix, len(order.own[number]) * self._d)
            if order.parent[number] < 0:
                corner += rest[-self._s :, -self._s :]
            else:
                waiting.setdefault(int(order.parent[number]), []).append(
                    (order.beyond[number], rest)
                )
        self._corner = np.linalg.cholesky(corner)

    def _rows(self, places: np.ndarray) -> np.ndarray:
        """Return the unknowns of blocks at `places`, (k,) → (k d,)."""
        return np.asarray((places[:, None] * self._d + np.arange(self._d)).reshape(-1))

    def _assembled(
        self,
        system: BlockSystem,
        number: int,
        mine: np.ndarray,
        children: list[tuple[np.ndarray, np.ndarray]],
    ) -> np.ndarray:
        """Return the front: own tiles, those beyond, the shared unknowns."""
        own, d, s = self._order.own[number], self._d, self._s
        tiles = np.concatenate([own, self._order.beyond[number]])
        place = {int(tile): k for k, tile in enumerate(tiles)}
        size = len(tiles) * d + s
        matrix = np.zeros((size, size))
        for k, tile in enumerate(own):
            here = slice(k * d, (k + 1) * d)
            matrix[here, here] += system.diagonal[tile]
            matrix[here, size - s :] += system.border[tile]
            matrix[size - s :, here] += system.border[tile].T
        for pair in mine:
            i, j = (place[int(tile)] * d for tile in system.pairs[pair])
            matrix[i : i + d, j : j + d] += system.coupling[pair]
            matrix[j : j + d, i : i + d] += system.coupling[pair].T
        for beyond, rest in children:
            at = self._rows(np.array([place[int(tile)] for tile in beyond], int))
            at = np.concatenate([at, np.arange(size - s, size)])
            matrix[np.ix_(at, at)] += rest
        return matrix

    def _eliminate(self, matrix: np.ndarray, count: int) -> np.ndarray:
        """Keep the factor of the first `count` unknowns; return what is added to those beyond."""
        lower = np.linalg.cholesky(matrix[:count, :count])
        across = solve_triangular(lower, matrix[:count, count:], lower=True, check_finite=False)
        self._fronts.append((lower, across))
        return np.asarray(matrix[count:, count:] - across.T @ across)

    def solve(self, blocks: np.ndarray, shared: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the unknowns, (n, d) or (n, d, k) and (s,) or (s, k), of a right side of the same shapes."""
        many = blocks.reshape(self._count * self._d, -1).astype(float)
        last = shared.reshape(self._s, -1).astype(float)
        for number, (lower, across) in enumerate(self._fronts):
            own, beyond = (self._rows(of[number]) for of in (self._order.own, self._order.beyond))
            many[own] = solve_triangular(lower, many[own], lower=True, check_finite=False)
            rest = across.T @ many[own]
            many[beyond] -= rest[: len(beyond)]
            last -= rest[len(beyond) :]
        last = solve_triangular(self._corner, last, lower=True)
        last = solve_triangular(self._corner, last, lower=True, trans=1)
        for number in reversed(range(len(self._fronts))):
            lower, across = self._fronts[number]
            own, beyond = (self._rows(of[number]) for of in (self._order.own, self._order.beyond))
            known = np.concatenate([many[beyond], last])
            many[own] = solve_triangular(
                lower, many[own] - across @ known, lower=True, trans=1, check_finite=False
            )
        return many.reshape(blocks.shape), last.reshape(shared.shape)

    def covariances(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return blocks of the inverse: of every tile, (n, d, d), of tiles with the shared unknowns, (n, d, s), and of these, (s, s).

        Only what the factor has entries for is computed ([takahashi1973]_).
        """
        d, s, order = self._d, self._s, self._order
        inverse = np.linalg.inv(self._corner)
        corner = inverse.T @ inverse
        blocks, border = np.empty((self._count, d, d)), np.empty((self._count, d, s))
        whole: dict[int, tuple[np.ndarray, np.ndarray]] = {}
        left = np.bincount(order.parent[order.parent >= 0], minlength=len(order.own))
        for number in reversed(range(len(self._fronts))):
            lower, across = self._fronts[number]
            own, parent = order.own[number], int(order.parent[number])
            outer = corner
            if parent >= 0:
                tiles, matrix = whole[parent]
                place = {int(tile): k for k, tile in enumerate(tiles)}
                at = self._rows(np.array([place[int(t)] for t in order.beyond[number]], int))
                at = np.concatenate([at, np.arange(len(matrix) - s, len(matrix))])
                outer = matrix[np.ix_(at, at)]
                left[parent] -= 1
                if not left[parent]:
                    del whole[parent]
            inverse = solve_triangular(lower, np.eye(len(lower)), lower=True, check_finite=False)
            along = inverse.T @ across
            mixed = -along @ outer
            inner = inverse.T @ inverse - mixed @ along.T
            for k, tile in enumerate(own):
                here = slice(k * d, (k + 1) * d)
                blocks[tile], border[tile] = inner[here, here], mixed[here, -s:]
            if left[number]:
                tiles = np.concatenate([own, order.beyond[number]])
                whole[number] = tiles, np.block([[inner, mixed], [mixed.T, outer]])
        return blocks, border, corner
