"""The schedule: which arm picks, inserts, holds and releases which piece, found together with the geometry that allows it.

A depth-first search over the steps of the plan. Each step tries arms and grasps, cheapest first, and keeps one only if the hand
serves at the feed and at the goal, the straight lines of approach, lift, insertion and retreat are free, hands and arms clear
each other, and a hold has its certificate. Every rejection is counted under its reason.
"""

from __future__ import annotations

import itertools
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np

from soma_bullet.errors import NoSolutionError
from soma_bullet.frames import Array, Mask, apply, inverse, readonly
from soma_bullet.grasp.clearance import MARGIN, OPENING, SUPPORT_MARGIN, hand_hulls, sweep_hand
from soma_bullet.motion.line import LineError, line_back
from soma_bullet.planner.assembly_plan import AssemblyPlan, PlanStep
from soma_bullet.planner.assist import HoldCertificate, certify_hold
from soma_bullet.planner.equilibrium import classify
from soma_bullet.robot.collision import Scene
from soma_bullet.task.feed import Feed
from soma_bullet.task.grasps import grasp_poses
from soma_bullet.task.workcell import TABLE, Hands, Workcell

APPROACH = 0.06  # [m] straight approach to a grasp and retreat from it
LIFT = 0.06  # [m] straight up from the feed
RUN_IN = 0.012  # [m] of insertion beyond the piece's own size
SMALLEST_MARGIN = 1.0  # of a hold's certificate
WIDTHS = (8, 24, 72, 1_000_000)  # candidates a step in each round of the search: broad and shallow before deep


@dataclass(frozen=True, eq=False)
class Release:
    """A hand lets go of a piece in place and retreats.

    Attributes:
        arm, piece: index and name.
        q_end: joints (6,) at the end of the retreat.
    """

    arm: int
    piece: str
    q_end: Array


@dataclass(frozen=True, eq=False)
class Assignment:
    """One step of the schedule.

    Attributes:
        step: index of the plan's step.
        piece, arm, grasp: what is inserted, by which arm, by which grasp of the piece's table.
        width: distance between the pads [m].
        q_pick: joints at the feed (6,); q_before: before the approach; q_lifted: after the lift.
        q_goal: joints at the goal (6,); q_ready: where the insertion starts.
        direction: unit assembly direction in the world (3,).
        length: of the insertion [m].
        holds: piece -> arm after the step.
        releases: in this order.
        certificate: of the hold that this grasp becomes, if it does.
    """

    step: int
    piece: str
    arm: int
    grasp: int
    width: float
    q_before: Array
    q_pick: Array
    q_lifted: Array
    q_ready: Array
    q_goal: Array
    direction: Array
    length: float
    holds: dict[str, int]
    releases: tuple[Release, ...]
    certificate: HoldCertificate | None


@dataclass(frozen=True, eq=False)
class Schedule:
    """Who does what.

    Attributes:
        assignments: one for each step of the plan.
        rejections: how often each reason ruled out a grasp, an arm or a hold on the way.
    """

    assignments: tuple[Assignment, ...]
    rejections: dict[str, int]


@dataclass(frozen=True, eq=False)
class _State:
    """Where the search stands: what is placed, and what the hands do."""

    placed: dict[str, Array]
    hands: Hands
    grip: dict[str, Array] = field(default_factory=dict)  # held piece -> T_world_tcp


@dataclass(frozen=True, eq=False)
class _Candidate:
    arm: int
    grasp: int
    T_piece_tcp: Array
    width: float
    contact: float


@dataclass(frozen=True, eq=False)
class _Lines:
    insertions: list[Array]
    picks: list[tuple[Array, Array]]

    @property
    def complete(self) -> bool:
        return bool(self.insertions and self.picks)


class Scheduler:
    """Searches schedules of one plan, feed and cell; checks that two schedules share are made once."""

    def __init__(self, workcell: Workcell, plan: AssemblyPlan, feed: Feed):
        self.workcell, self.plan, self.feed = workcell, plan, feed
        self.robot = workcell.robot
        self.hand = workcell.cell.arms[0].hand
        self.rejections: Counter[str] = Counter()
        self.excluded: set[tuple[int, int, int]] = set()  # (step, arm, grasp) that a later stage ruled out
        self._made: dict[tuple[int, int, int], _Lines] = {}
        self._scenes: dict[tuple[object, ...], Scene] = {}
        self._certificates: dict[tuple[int, int], HoldCertificate] = {}

    def find(self) -> Schedule:
        """The first schedule. Raises NoSolutionError with what blocked, most frequent first."""
        state = _State({}, self.workcell.idle())
        for width in WIDTHS:
            for assignments in self._search(0, state, width):
                return Schedule(tuple(assignments), dict(self.rejections.most_common()))
        raise NoSolutionError(
            "schedule", f"no arm and grasp serve every step of {' <- '.join(self.plan.order)}", self.rejections
        )

    def _search(self, k: int, state: _State, width: int) -> Iterator[list[Assignment]]:
        if k == len(self.plan.steps):
            yield []
            return
        for candidate in itertools.islice(self._candidates(k, state), width):
            if (k, candidate.arm, candidate.grasp) in self.excluded:
                continue
            outcome = self._try(k, state, candidate)
            if outcome is None:
                continue
            assignment, after = outcome
            for rest in self._search(k + 1, after, width):
                yield [assignment, *rest]

    def _reject(self, step: PlanStep, reason: str) -> None:
        self.rejections[f"{step.piece}: {reason}"] += 1

    # --- candidates, cheapest first ------------------------------------------------------------------------------------

    def _candidates(self, k: int, state: _State) -> Iterator[_Candidate]:
        """Grasps of the step's piece, with arms, that pass the tests of the hand alone; the most promising first."""
        step = self.plan.steps[k]
        poses, widths = grasp_poses(self.plan, step.piece)
        contact = next(t for t in self.plan.grasps if t.piece == step.piece).contact
        chosen = set(step.grasps)
        stays = any(hold.piece == step.piece for hold in step.holds)
        if stays:
            chosen &= set(next(hold for hold in step.holds if hold.piece == step.piece).grasps)
        indices = np.array(sorted(chosen), int)
        if not len(indices):
            self._reject(step, "no accessible grasp" + (" that may hold it" if stays else ""))
            return
        clear = self._clear_at_feed(k, poses[indices], widths[indices])
        self.rejections[f"{step.piece}: hand touches the table or a piece at the feed"] += int((~clear).sum())
        indices = indices[clear]
        clear = self._clear_of_holders(k, state, poses[indices], widths[indices])
        self.rejections[f"{step.piece}: hand meets a holding hand or a placed piece on its way in"] += int((~clear).sum())
        indices = indices[clear]
        busy = set(state.hands.gripped.values())
        free_arms = [arm for arm in range(len(self.workcell.cell.arms)) if arm not in busy]
        feed = self.feed.pose(step.piece)
        piece = self.workcell.assembly.pieces[self.workcell.assembly.index(step.piece)]
        com = apply(feed, piece.center_of_mass)
        tcp = feed @ poses[indices]
        reach = np.linalg.norm(tcp[:, :3, 3] - com, axis=1)
        tilt = np.arccos(np.clip(-tcp[:, 2, 2], -1, 1))
        cost = reach / 0.03 + (1 - contact[indices]) + 0.5 * tilt
        distance = {arm: np.linalg.norm(com - self.robot.arm(arm).T_world_base[:3, 3]) for arm in free_arms}
        groups: dict[tuple[float, ...], list[_Candidate]] = {}  # by arm and direction of the hand: each may fail as a whole
        for rank in np.argsort(np.round(cost, 9), kind="stable"):
            g = int(indices[rank])
            for arm in sorted(free_arms, key=lambda a: distance[a]):
                key = (arm, *np.round(poses[g][:3, 2] * 4), *np.round(poses[g][:3, 0] * 4))
                groups.setdefault(key, []).append(_Candidate(arm, g, poses[g], float(widths[g]), float(contact[g])))
        usable = [(c for c in group if self._lines(k, c).complete) for group in groups.values()]
        for turn in itertools.zip_longest(*usable):
            yield from (c for c in turn if c is not None)

    def _clear_at_feed(self, k: int, poses: Array, widths: Array) -> Mask:
        step = self.plan.steps[k]
        sweep = sweep_hand(self.hand, self.feed.pose(step.piece) @ poses, widths)
        clear = sweep.above(0.0) > SUPPORT_MARGIN
        for later in self.plan.steps[k + 1 :]:
            parts = self.workcell.assembly.pieces[self.workcell.assembly.index(later.piece)].parts
            clear &= sweep.separation([part.moved(self.feed.pose(later.piece)) for part in parts]) > MARGIN
        return clear

    def _clear_of_holders(self, k: int, state: _State, poses: Array, widths: Array) -> Mask:
        """Whether the hand, swept along the insertion, keeps clear of placed pieces and of the hands that hold."""
        step = self.plan.steps[k]
        goal = self.workcell.goals[step.piece]
        sweep = sweep_hand(self.hand, goal @ poses, widths, way_out=0.0, sweep=-np.array(step.direction) * (step.way + RUN_IN))
        obstacles = []
        for name in state.placed:
            parts = self.workcell.assembly.pieces[self.workcell.assembly.index(name)].parts
            obstacles += [part.moved(self.workcell.goals[name]) for part in parts]
        clear = sweep.separation(obstacles) > 0.0
        leaving = sweep_hand(self.hand, goal @ poses, widths)
        for T_world_tcp in state.grip.values():
            holder = hand_hulls(self.hand, T_world_tcp, 0.03)
            clear &= (sweep.separation(holder) > MARGIN) & (leaving.separation(holder) > MARGIN)
        return clear

    # --- one candidate -------------------------------------------------------------------------------------------------

    def _try(self, k: int, state: _State, candidate: _Candidate) -> tuple[Assignment, _State] | None:
        """The assignment of a candidate and the state after it, or None with the reason counted."""
        step = self.plan.steps[k]
        certificate = None
        if any(hold.piece == step.piece for hold in step.holds):
            certificate = self._certificate(k, candidate)
            if certificate.margin < SMALLEST_MARGIN:
                self._reject(step, f"the hold would slip (margin below {SMALLEST_MARGIN:g})")
                return None
        insertion = self._insertion(k, state, candidate)
        if insertion is None:
            return None
        q_goal, q_ready = insertion
        pick = self._pick(k, state, candidate)
        if pick is None:
            return None
        q_before, q_pick, q_lifted = pick
        after = self._releases(k, state, candidate, q_goal)
        if after is None:
            return None
        releases, final = after
        assignment = Assignment(
            step=k, piece=step.piece, arm=candidate.arm, grasp=candidate.grasp, width=candidate.width,
            q_before=readonly(q_before), q_pick=readonly(q_pick), q_lifted=readonly(q_lifted),
            q_ready=readonly(q_ready), q_goal=readonly(q_goal), direction=readonly(step.direction), length=step.way + RUN_IN,
            holds=dict(final.hands.gripped), releases=releases, certificate=certificate,
        )  # fmt: skip
        return assignment, final

    def _certificate(self, k: int, candidate: _Candidate) -> HoldCertificate:
        assembly, step = self.workcell.assembly, self.plan.steps[k]
        if (k, candidate.grasp) in self._certificates:
            return self._certificates[k, candidate.grasp]
        following = self.plan.steps[k + 1] if k + 1 < len(self.plan.steps) else None
        placed = frozenset(assembly.index(s.piece) for s in self.plan.steps[: k + 1])
        held = assembly.index(step.piece)
        self._certificates[k, candidate.grasp] = certify_hold(
            assembly, self.hand, placed, held, assembly.goals[held] @ candidate.T_piece_tcp,
            "dropped" if step.verdict == "robust" else "frictionless",
            None if following is None else assembly.index(following.piece),
            None if following is None else np.array(following.direction), contact=candidate.contact,
        )  # fmt: skip
        return self._certificates[k, candidate.grasp]

    def _insertion(self, k: int, state: _State, candidate: _Candidate) -> tuple[Array, Array] | None:
        """Joints at the goal and where the insertion starts: the first branch whose whole line is free."""
        step = self.plan.steps[k]
        hands = state.hands.gripping(candidate.arm, step.piece)
        scene: Scene | None = None
        for line in self._lines(k, candidate).insertions:
            scene = scene or self._insertion_scene(k, state.placed, hands, candidate)
            if self._free(line, scene, hands, candidate, candidate.width, "insertion", step):
                return line[0], line[-1]
        return None

    def _pick(self, k: int, state: _State, candidate: _Candidate) -> tuple[Array, Array, Array] | None:
        """Joints before the approach, at the grasp, and after the lift."""
        step = self.plan.steps[k]
        hands = state.hands.gripping(candidate.arm, step.piece)
        scenes: tuple[Scene, Scene] | None = None
        for approach, lift in self._lines(k, candidate).picks:
            scenes = scenes or self._pick_scenes(k, state.placed, hands, candidate)
            open_width = candidate.width + 2 * OPENING
            if self._free(approach, scenes[0], hands, candidate, open_width, "approach", step) and self._free(
                lift, scenes[1], hands, candidate, candidate.width, "lift", step
            ):
                return approach[-1], approach[0], lift[-1]
        return None

    def _free(
        self, line: Array, scene: Scene, hands: Hands, candidate: _Candidate, width: float, name: str, step: PlanStep
    ) -> bool:
        for q in line:
            if scene.collides(self.workcell.configuration(hands, candidate.arm, q, width)):
                self._reject_line(step, name, LineError("collision", 0.0, q), scene, hands, candidate, width)
                return False
        return True

    # --- lines of one candidate with the other arm left out: made once ---------------------------------------------------

    def _lines(self, k: int, candidate: _Candidate) -> _Lines:
        """All branches' lines that are free of table, stand, pieces and the arm itself; empty where there are none."""
        key = (k, candidate.arm, candidate.grasp)
        if key not in self._made:
            insertions = self._make_insertions(k, candidate)
            self._made[key] = _Lines(insertions, self._make_picks(k, candidate) if insertions else [])
        return self._made[key]

    def _settled_before(self, k: int) -> dict[str, Array]:
        return {s.piece: self.workcell.settled[s.piece] for s in self.plan.steps[:k]}

    def _insertion_scene(
        self, k: int, placed: dict[str, Array], hands: Hands, candidate: _Candidate, alone: bool = False
    ) -> Scene:
        step, cell = self.plan.steps[k], self.workcell
        remaining = {s.piece: self.feed.pose(s.piece) for s in self.plan.steps[k + 1 :]}
        meant = frozenset(p for p in cell.touching if step.piece in p)
        carried = (step.piece, inverse(candidate.T_piece_tcp))
        scene = self._scene("insertion", k, {**placed, **remaining}, hands, candidate.arm, carried, meant, alone)
        return scene

    def _pick_scenes(
        self, k: int, placed: dict[str, Array], hands: Hands, candidate: _Candidate, alone: bool = False
    ) -> tuple[Scene, Scene]:
        step, arm = self.plan.steps[k], candidate.arm
        poses = {**placed, **{s.piece: self.feed.pose(s.piece) for s in self.plan.steps[k:]}}
        carried = (step.piece, inverse(candidate.T_piece_tcp))
        lying = frozenset({frozenset({step.piece, TABLE})})
        return (
            self._scene("approach", k, poses, hands, arm, None, frozenset(), alone),
            self._scene("lift", k, poses, hands, arm, carried, lying, alone),
        )

    def _scene(
        self, name: str, k: int, poses: dict[str, Array], hands: Hands, arm: int,
        carried: tuple[str, Array] | None, touching: frozenset[frozenset[str]], alone: bool,
    ) -> Scene:  # fmt: skip
        """A scene, or the one made for another grasp of the same step with the piece put differently into the hand."""
        others = () if alone else tuple(sorted(hands.gripped.items()))
        key = (name, k, arm, others)
        if key not in self._scenes:
            self._scenes[key] = self.workcell.scene(poses, hands, arm, carried, touching, alone)
        elif carried is not None:
            self._scenes[key].attach(carried[0], arm, carried[1])
        return self._scenes[key]

    def _make_insertions(self, k: int, candidate: _Candidate) -> list[Array]:
        step, cell = self.plan.steps[k], self.workcell
        T_goal = cell.settled[step.piece] @ candidate.T_piece_tcp
        hands = cell.idle().gripping(candidate.arm, step.piece)
        scene = self._insertion_scene(k, self._settled_before(k), hands, candidate, alone=True)
        solutions = self.robot.inverse(candidate.arm, T_goal, self.robot.home[candidate.arm])
        if not len(solutions):
            self._reject(step, f"{self.robot.arm(candidate.arm).name} arm does not reach the goal")
        away = (-np.array(step.direction), step.way + RUN_IN)
        lines = [self._trace(step, "insertion", candidate, q, T_goal, away, scene, hands, candidate.width) for q in solutions]
        return [line for line in lines if line is not None]

    def _make_picks(self, k: int, candidate: _Candidate) -> list[tuple[Array, Array]]:
        step, cell, arm = self.plan.steps[k], self.workcell, candidate.arm
        T_pick = self.feed.pose(step.piece) @ candidate.T_piece_tcp
        hands = cell.idle().gripping(arm, step.piece)
        arriving, leaving = self._pick_scenes(k, self._settled_before(k), hands, candidate, alone=True)
        solutions = self.robot.inverse(arm, T_pick, self.robot.home[arm])
        if not len(solutions):
            self._reject(step, f"{self.robot.arm(arm).name} arm does not reach the feed")
        back, up = (-T_pick[:3, 2], APPROACH), (np.array([0.0, 0.0, 1.0]), LIFT)
        picks = []
        for q in solutions:
            approach = self._trace(step, "approach", candidate, q, T_pick, back, arriving, hands, candidate.width + 2 * OPENING)
            if approach is None:
                continue
            lift = self._trace(step, "lift", candidate, q, T_pick, up, leaving, hands, candidate.width)
            if lift is not None:
                picks.append((approach, lift))
        return picks

    def _trace(
        self,
        step: PlanStep,
        name: str,
        candidate: _Candidate,
        q: Array,
        T: Array,
        away: tuple[Array, float],
        scene: Scene,
        hands: Hands,
        width: float,
    ) -> Array | None:
        try:
            return line_back(
                self.robot, candidate.arm, q, T, *away,
                lambda p: scene.collides(self.workcell.configuration(hands, candidate.arm, p, width)),
            )  # fmt: skip
        except LineError as error:
            self._reject_line(step, name, error, scene, hands, candidate, width)
            return None

    def _releases(
        self, k: int, state: _State, candidate: _Candidate, q_goal: Array
    ) -> tuple[tuple[Release, ...], _State] | None:
        """Which hands let go after the step, in an order that keeps the state stable, each with its free retreat."""
        step, cell = self.plan.steps[k], self.workcell
        placed = {**state.placed, step.piece: cell.settled[step.piece]}
        hands = state.hands.with_arm(candidate.arm, q_goal, candidate.width).gripping(candidate.arm, step.piece)
        grip = {**state.grip, step.piece: cell.goals[step.piece] @ candidate.T_piece_tcp}
        keep = {hold.piece for hold in step.holds}
        if not keep <= set(grip):
            self._reject(step, f"nothing holds {', '.join(sorted(keep - set(grip)))} yet")
            return None
        indices = frozenset(cell.assembly.index(name) for name in placed)
        letting_go = sorted(set(grip) - keep, key=lambda name: name == step.piece)  # the inserter last, if it may
        order = next((o for o in (letting_go, letting_go[::-1]) if self._stable_all_along(indices, set(grip), o)), None)
        if order is None:
            self._reject(step, "letting go would let the state fall in any order")
            return None
        releases = []
        for name in order:
            arm = hands.gripped[name]
            q_end = self._retreat(step, placed, hands, arm, name)
            if q_end is None:
                return None
            releases.append(Release(arm, name, readonly(q_end)))
            hands = hands.with_arm(arm, q_end).gripping(arm, None)
            grip = {piece: T for piece, T in grip.items() if piece != name}
        for arm in range(len(cell.cell.arms)):  # an idle arm waits at home
            if arm not in hands.gripped.values():
                hands = hands.with_arm(arm, self.robot.home[arm], 0.0)
        return tuple(releases), _State(placed, hands, grip)

    def _stable_all_along(self, placed: frozenset[int], held: set[str], order: list[str]) -> bool:
        for name in order:
            held = held - {name}
            indices = frozenset(self.workcell.assembly.index(n) for n in held)
            if classify(self.workcell.assembly, placed, indices).verdict == "unstable":
                return False
        return True

    def _retreat(self, step: PlanStep, placed: dict[str, Array], hands: Hands, arm: int, piece: str) -> Array | None:
        """Joints at the end of the straight retreat from a piece in place."""
        cell = self.workcell
        remaining = {n: self.feed.pose(n) for n in self.feed.names if n not in placed}
        scene = cell.scene({**placed, **remaining}, hands, arm)
        opening = hands.openings[arm] + 2 * OPENING
        T = self.robot.tcp(arm, hands.qs[arm])
        try:
            line = line_back(
                self.robot, arm, hands.qs[arm], T, -T[:3, 2], APPROACH,
                lambda q: scene.collides(cell.configuration(hands, arm, q, opening)),
            )  # fmt: skip
        except LineError as error:
            self._reject_line(step, f"retreat from {piece}", error, scene, hands, None)
            return None
        return line[-1]

    def _reject_line(
        self,
        step: PlanStep,
        line: str,
        error: LineError,
        scene: Scene,
        hands: Hands,
        candidate: _Candidate | None,
        width: float = 0.0,
    ) -> None:
        if error.cause != "collision" or error.q is None or candidate is None:
            self._reject(step, f"{line}: {error.cause}")
            return
        pair = scene.first_collision(self.workcell.configuration(hands, candidate.arm, error.q, width))
        self._reject(step, f"{line}: {pair[0]} meets {pair[1]}" if pair else f"{line}: collision")
