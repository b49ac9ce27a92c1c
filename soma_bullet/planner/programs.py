"""Linear programs of statics: contact forces that balance a load, and how far the load may go.

One model a set of bodies; further questions change its objective or one column only, and start from the last
solution."""

from __future__ import annotations

from typing import Any

import highspy
import numpy as np

from soma_bullet.frames import Array

LARGEST = 1e3  # [g, or multiples of the load] stands for "no limit"
MOST_QUESTIONS = 500  # about ten are usual
# above the last digits of the solver: an edge of a region is final once no point lies farther out than this
EXACT = 1e-8


def _solver(columns: Array, extra: Array, limits: Array, lower: Array, upper: Array, balance: Array) -> Any:
    """A model: columns @ x = balance, extra @ x <= limits, lower <= x <= upper; the objective is set
    later."""
    matrix = np.vstack([columns, extra])
    program = highspy.HighsLp()
    program.num_row_, program.num_col_ = matrix.shape
    program.col_cost_ = np.zeros(matrix.shape[1])
    program.col_lower_, program.col_upper_ = lower, upper
    program.row_lower_ = np.concatenate([balance, np.full(len(extra), -highspy.kHighsInf)])
    program.row_upper_ = np.concatenate([balance, limits])
    column, row = np.nonzero(np.abs(matrix.T) > 1e-12)
    program.a_matrix_.format_ = highspy.MatrixFormat.kColwise
    program.a_matrix_.start_ = np.searchsorted(column, np.arange(matrix.shape[1] + 1)).astype(np.int32)
    program.a_matrix_.index_ = row.astype(np.int32)
    program.a_matrix_.value_ = matrix[row, column]
    solver = highspy.Highs()
    solver.silent()
    solver.setOptionValue("presolve", "off")
    solver.setOptionValue("threads", 1)
    solver.setOptionValue(
        "simplex_strategy", 4
    )  # primal: what changes between questions leaves the last solution feasible
    solver.passModel(program)
    return solver


class PushRegion:
    """The pushes a (2,) for which columns @ lambda + load + a @ pushes = 0 has a solution lambda >= 0: a
    convex polygon.

    Its corners are found as they are needed: only the objective changes between questions (T. Bretl, S. Lall,
    "Testing static equilibrium for legged robots", IEEE Trans. Robotics 24(4), 2008, project a polytope in
    this way).

    Args:
        columns: wrenches of the unit forces (rows, m).
        scaling: of the rows (rows,).
        load: (rows,).
        pushes: (2, rows).
        largest: bound of both coordinates of a.
    """

    def __init__(self, columns: Array, scaling: Array, load: Array, pushes: Array, largest: float = LARGEST):
        rows, self.count = columns.shape
        matrix = np.hstack([columns, pushes.T]) * scaling[:, None]
        lower = np.concatenate([np.zeros(self.count), [-largest, -largest]])
        upper = np.concatenate([np.full(self.count, highspy.kHighsInf), [largest, largest]])
        self.largest = largest
        self.solver = _solver(
            matrix, np.zeros((0, self.count + 2)), np.zeros(0), lower, upper, -load * scaling
        )
        self.last = np.array([self.count, self.count + 1], np.int32)

    def extreme(self, direction: Array) -> Array | None:
        """The point (2,) of the region that lies farthest along a direction (2,); None where the region is
        empty."""
        self.solver.changeColsCost(2, self.last, -direction)
        self.solver.run()
        if self.solver.getModelStatus() != highspy.HighsModelStatus.kOptimal:
            return None
        return np.array(self.solver.getSolution().col_value[self.count :])

    def smallest_reach(self, angles: Array) -> float:
        """Smallest distance from the origin to the border along directions (n,) [rad]; 0 where the origin is
        not inside."""
        corners: list[tuple[float, Array]] = []
        for angle in np.pi / 2 * np.arange(4):
            point = self.extreme(np.array([np.cos(angle), np.sin(angle)]))
            if point is None:
                return 0.0
            corners.append((float(angle), point))
        rays = np.column_stack([np.cos(angles), np.sin(angles)])
        final: set[tuple[float, float]] = set()
        reach = 0.0
        for _ in range(MOST_QUESTIONS):
            points = np.array([point for _, point in corners])
            edges = np.roll(points, -1, axis=0) - points
            length = np.linalg.norm(edges, axis=1)
            real = np.flatnonzero(length > EXACT)
            if not len(real):
                return 0.0
            normals = np.column_stack([edges[real, 1], -edges[real, 0]]) / length[real, None]
            offsets = np.einsum("ij,ij->i", normals, points[real])
            if offsets.min() < -EXACT:  # the origin lies outside what is known so far
                edge, reach = int(np.argmin(offsets)), 0.0
            else:
                facing = rays @ normals.T
                distance = np.where(
                    facing > 1e-9, np.maximum(offsets, 0.0) / np.maximum(facing, 1e-9), np.inf
                )
                ray, edge = divmod(int(np.argmin(distance)), distance.shape[1])
                reach = float(distance[ray, edge])
            key = (corners[real[edge]][0], corners[(real[edge] + 1) % len(corners)][0])
            if key in final:
                return min(reach, self.largest)
            point = self.extreme(normals[edge])
            if point is None or normals[edge] @ point <= offsets[edge] + EXACT * max(1.0, abs(offsets[edge])):
                final.add(key)
                continue
            angle = float(np.arctan2(normals[edge, 1], normals[edge, 0]) % (2 * np.pi))
            corners.insert(int(real[edge]) + 1, (angle, point))
        return min(reach, self.largest)  # a lower bound: the known corners lie inside the region


class RayProgram:
    """max t, subject to columns @ lambda + load + t * push = 0, lambda >= 0 (and optional bounds): one model,
    many rays."""

    def __init__(self, columns: Array, scaling: Array, upper_rows: tuple[Array, Array] | None = None):
        self.scaling = scaling
        rows, count = columns.shape
        extra, limits = upper_rows if upper_rows is not None else (np.zeros((0, count)), np.zeros(0))
        self.rows = rows
        lower, upper = np.zeros(count + 1), np.concatenate([np.full(count, highspy.kHighsInf), [LARGEST]])
        # the last column is the push, set for each ray
        matrix = np.hstack([columns * scaling[:, None], np.zeros((rows, 1))])
        self.solver = _solver(
            matrix, np.hstack([extra, np.zeros((len(extra), 1))]), limits, lower, upper, np.zeros(rows)
        )
        self.solver.changeColCost(count, -1.0)
        self.last = count

    def farthest(self, load: Array, push: Array) -> float:
        """Largest t in [0, LARGEST]; -1 where even t = 0 has no solution. load, push: (rows,)."""
        bounds = -load * self.scaling
        every = np.arange(self.rows, dtype=np.int32)
        self.solver.changeRowsBounds(self.rows, every, bounds, bounds)
        for row, amount in enumerate(push * self.scaling):
            self.solver.changeCoeff(row, self.last, float(amount))
        self.solver.run()
        if self.solver.getModelStatus() != highspy.HighsModelStatus.kOptimal:
            return -1.0
        return float(self.solver.getInfo().objective_function_value) * -1.0
