"""The MuJoCo rope obeys mechanics: it falls, hangs, swings; its gripper goes where it is told; runs repeat."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest
from plant_cases import free_rope, hurry, plan, run_free, still
from scipy.optimize import brentq

from pred_core.errors import ConfigError, DivergenceError
from pred_core.plant.drive import Drive, poses
from pred_core.plant.hidden.effect import HiddenEffect
from pred_core.plant.hidden.library import make_effect
from pred_core.plant.motion import FAST, draw_motion
from pred_core.plant.rope import STEP, RopeConfig, RopeModel, build_rope
from pred_core.plant.rope_case import check_gripper, simulate_rope
from pred_core.plant.session import SessionConfig, plan_session
from pred_core.plant.world import Record, World, run_episode


def test_the_centre_of_a_free_rope_falls_as_a_stone() -> None:
    """Bent and relaxing while it falls; semi-implicit Euler drops g h^2 n (n + 1) / 2 in n steps."""
    free = free_rope()
    generator = np.random.default_rng(0)
    for at in free.joint_qpos:
        q = np.concatenate([[1.0], generator.normal(0.0, 0.01, 3)])
        free.data.qpos[at : at + 4] = q / np.linalg.norm(q)
    mujoco.mj_forward(free.model, free.data)
    before = (free.mass[:, None] * free.position).sum(axis=0) / free.mass.sum()
    run_free(free, 0.3)
    mujoco.mj_forward(free.model, free.data)
    after = (free.mass[:, None] * free.position).sum(axis=0) / free.mass.sum()
    assert free.mass.sum() == pytest.approx(0.05, rel=1e-12)
    # 90 steps: 9.81 / 300^2 * 90 * 91 / 2 = 0.446355 m. The joints' armature is no mass; its share is of order 1e-4.
    assert after - before == pytest.approx([0.0, 0.0, -0.446355], abs=2e-4)


def test_a_still_rope_hangs_as_a_plumb_line() -> None:
    record = run_episode(World(build_rope(RopeConfig())), still(), 0.1, 30)
    line = record.position[-1]
    top = record.gripper[-1, :3]
    assert np.abs(line[:, :2] - top[:2]).max() < 1e-6
    assert line[:, 2] == pytest.approx(top[2] - np.linspace(0.0, 0.7, 30), abs=1e-6)
    assert np.abs(record.position[0] - line).max() < 1e-6  # and stays there


def test_a_limp_rope_between_two_nails_is_a_catenary() -> None:
    """z = a cosh(x / a), with 2 a sinh(d / 2a) = L for L = 0.7 m and d = 0.5 m."""
    rope = build_rope(RopeConfig(bending=1e-6, damping=0.1), gripper=False)
    for link, place in ((0, [-0.25, 0.0, 2.0]), (31, [0.25, 0.0, 2.0])):
        body = rope.links[link]
        anchor = rope.spec.worldbody.add_site(name=f"nail{link}", pos=place)
        end = body.add_site(name=f"end{link}", pos=[0.0, 0.0, 0.0 if link == 0 else -rope.rope.link_length])
        rope.spec.add_equality(
            type=mujoco.mjtEq.mjEQ_CONNECT, objtype=mujoco.mjtObj.mjOBJ_SITE, name1=anchor.name, name2=end.name
        )
    world = World(rope)
    # Laid as a V whose legs are 0.35 m long: each leans by asin(0.25 / 0.35) from straight down, towards +x.
    lean = np.arcsin(0.25 / 0.35)
    world.data.qpos[:7] = (-0.25, 0.0, 2.0, np.cos(-0.5 * lean), 0.0, np.sin(-0.5 * lean), 0.0)
    turn = -(np.pi - 2.0 * lean)
    middle = int(world.joint_qpos[np.flatnonzero(world.joint_link == 16)[0]])
    world.data.qpos[middle : middle + 4] = (np.cos(0.5 * turn), 0.0, np.sin(0.5 * turn), 0.0)
    for _ in range(round(3.0 / STEP)):
        world.step(drag=6.0)
    mujoco.mj_forward(world.model, world.data)
    line = world.material_points(np.linspace(0.0, 0.7, 33))
    a = brentq(lambda a: 2.0 * a * np.sinh(0.25 / a) - 0.7, 0.05, 5.0)
    expected = 2.0 + a * (np.cosh(line[:, 0] / a) - np.cosh(0.25 / a))
    # The connections are soft (about 1 mm) and the links straight (22 mm); the sag is 218 mm.
    assert expected.min() == pytest.approx(1.785, abs=0.01)
    assert np.abs(line[:, 2] - expected).max() < 0.004


def test_the_rope_feels_its_inertia_and_swings_with_its_own_period() -> None:
    """A hanging chain: w = 1.2024 sqrt(g / L) (half the first zero of J0), L = 0.678125 m below the jaws: 1.374 s."""
    rope = build_rope(RopeConfig(bending=1e-6, damping=0.0, armature=1e-9))
    world = World(rope)
    motion = still()
    world.data.qpos[: len(motion.home)] = motion.home
    first = int(world.joint_qpos[0])
    world.data.qpos[first : first + 4] = (np.cos(0.01), 0.0, np.sin(0.01), 0.0)  # 0.02 rad at the jaws
    drive = Drive(motion.path(0.0, 1400, STEP))
    tip = np.empty(1350)
    for k in range(len(tip)):
        world.step(drive, k)
        tip[k] = world.material_points(np.array([0.7]))[0, 0] - motion.home[0]
    spectrum = np.abs(np.fft.rfft((tip - tip.mean()) * np.hanning(len(tip)), 16 * len(tip)))
    period = 16 * len(tip) * STEP / spectrum.argmax()
    assert period == pytest.approx(1.374, rel=0.02)


@pytest.mark.parametrize("regime", ["air", "table"])
def test_the_gripper_is_where_it_was_told_to_be_whatever_it_carries(regime: str, monkeypatch) -> None:
    hurry(monkeypatch)
    record, _ = simulate_rope(plan(regime, "fast"), (("heavy_tip", 9.0),), 5, 1.0, 30)
    assert np.abs(record.gripper - record.reference).max() < 1e-6  # [m], [rad]; asked for: 1 mm
    assert np.abs(np.diff(record.reference[:, :3], axis=0)).max() / STEP > 0.1  # it did move
    # The material points in the jaws go with it: 0 and 24.1 mm along the gripper's -z axis.
    place, q = poses(record.gripper)
    w, x, y, z = q.T
    down = -np.stack([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)], axis=-1)
    assert record.position[:, 0] == pytest.approx(place, abs=1e-9)
    # The jaws end after 21.9 mm: the last 2.2 mm turn with the rope, by less than 45 degrees.
    stray = np.linalg.norm(record.position[:, 1] - place - 0.7 / 29 * down, axis=-1)
    assert stray.max() < 2 * 2.3e-3 * np.sin(np.pi / 8)


def test_a_seed_gives_the_same_run_bit_for_bit(monkeypatch) -> None:
    hurry(monkeypatch)
    a, b = (simulate_rope(plan("table"), (), 5, 0.3, 30)[0] for _ in range(2))
    assert np.array_equal(a.position, b.position) and np.array_equal(a.gripper, b.gripper)
    other, _ = simulate_rope(plan("table", seed=6), (), 6, 0.3, 30)
    assert np.abs(other.position - a.position).max() > 1e-3


def test_a_settled_rope_lies_still_on_the_table() -> None:
    record, _ = simulate_rope(plan("table"), (), 5, 0.1, 30)
    start = record.position[:30]  # before the gripper moves, 0.3 s to 0.2 s before time 0
    assert np.abs(start[-1] - start[0]).max() < 5e-4
    low = start[-1][start[-1][:, 2] < 0.006]
    assert len(low) > 12 and low[:, 2] == pytest.approx(0.004, abs=1e-3)  # its radius above the table


def test_families_of_motion() -> None:
    usual, fast, high = (plan("air", v).motion for v in ("usual", "fast", "height"))
    assert high.home - usual.home == pytest.approx([0.0, 0.0, 0.25, 0.0, 0.0, 0.0])
    # After the onset, the faster motion is at 1.5 t where the usual one is at t.
    steps = round(usual.onset / STEP)
    slow_path, fast_path = (m.path(usual.onset, 600, STEP).position for m in (usual, fast))
    assert steps > 0 and fast_path[200] == pytest.approx(slow_path[round(200 * FAST)], abs=1e-9)
    # A regrasped rope hangs with its other end in the jaws: the particles keep their numbers.
    record, _ = simulate_rope(plan("air", "regrasp"), (), 5, 0.1, 30)
    assert record.position[0, 29] == pytest.approx(record.gripper[0, :3], abs=1e-9)
    assert record.position[0, 0, 2] < record.position[0, 29, 2] - 0.6
    with pytest.raises(ConfigError, match="motion"):
        draw_motion(np.random.default_rng(0), "sea", "usual", 1.0)


def test_a_world_that_blows_up_says_so(monkeypatch, tmp_path) -> None:
    hurry(monkeypatch)
    monkeypatch.chdir(tmp_path)
    rope = build_rope(RopeConfig())
    effect = make_effect("drag_linear", 1.0, 0)
    effect.magnitude = -5e3  # feeds energy in, beyond what the command line allows
    with pytest.raises(DivergenceError, match="unstable"):
        run_episode(World(rope, [effect]), plan("air").motion, 0.3, 30)
    assert not list(tmp_path.iterdir())  # MuJoCo's own log file is not left behind


def test_a_whip_too_fast_for_the_step_is_simulated_anew_with_a_finer_one(monkeypatch: pytest.MonkeyPatch) -> None:
    """An episode without anything hidden on which MuJoCo gave up after 4.5 s: its free end whips with 7 m/s."""
    whip = plan_session(SessionConfig(train=12, test=4, ood=3, seconds=4.0), 50256)[4]
    record, _ = simulate_rope(whip, (), 50256, 4.0, 30)
    assert len(record.time) == 1 + round((0.3 + 4.0) / STEP) + 1 and np.isfinite(record.position).all()
    assert np.abs(record.gripper - record.reference).max() < 1e-4, "the gripper went where it was told"
    asked = whip.motion.path(-0.3, len(record.time), STEP).position
    assert np.abs(record.reference - asked).max() < 1e-12, "and that does not depend on the step"
    length = np.linalg.norm(np.diff(record.position, axis=1), axis=-1).sum(axis=1)
    assert length.max() < 0.7 + 1e-6 and length.min() > 0.68
    monkeypatch.setattr("pred_core.plant.rope_case.PARTS", (1,))
    with pytest.raises(DivergenceError, match=r"ep004: the rope's simulation became unstable.*Use another seed\.$"):
        simulate_rope(whip, (), 50256, 4.0, 30)


def test_a_finer_step_tells_the_same_story_and_a_step_that_holds_is_kept(monkeypatch: pytest.MonkeyPatch) -> None:
    """Semi-implicit Euler is of first order: halving the step moves a calm rope by some millimetres in a second."""
    hurry(monkeypatch)
    calm = plan("air", seconds=1.0)
    once = run_episode(World(build_rope(RopeConfig())), calm.motion, 1.0, 30)
    twice = run_episode(World(build_rope(RopeConfig())), calm.motion, 1.0, 30, parts=2)
    assert np.array_equal(simulate_rope(calm, (), 0, 1.0, 30)[0].position, once.position), "bit for bit"
    assert np.array_equal(once.time, twice.time) and np.array_equal(once.reference, twice.reference)
    moved = np.linalg.norm(once.position[-1] - once.position[0], axis=-1).max()
    apart = np.linalg.norm(once.position - twice.position, axis=-1).max()
    assert 0.0 < apart < 0.05 * moved, (apart, moved)


def test_a_ball_in_the_grippers_way_is_told_also_where_the_usual_step_holds(monkeypatch: pytest.MonkeyPatch) -> None:
    """Its middle is where the jaws are to be after a second: they stop a radius, 2 cm, before; 1 mm is allowed."""
    hurry(monkeypatch)
    calm = plan("air", seconds=1.0)
    path = calm.motion.path(0.0, round(1.0 / STEP), STEP).position[:, :3]
    assert np.linalg.norm(path[-1] - path[0]) > 0.05, "it does not stand there from the beginning"

    class Ball(HiddenEffect):
        def build(self, rope: RopeModel) -> None:
            rope.spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[0.02, 0, 0], pos=path[-1])

    ball = Ball(0.02, np.random.default_rng(0))
    kept = run_episode(World(build_rope(RopeConfig()), [ball]), calm.motion, 1.0, 30)  # MuJoCo warns of nothing
    assert np.linalg.norm((kept.gripper - kept.reference)[-1, :3]) > 0.01
    monkeypatch.setattr("pred_core.plant.rope_case.make_effect", lambda *_: ball)
    with pytest.raises(DivergenceError, match="what is hidden stands in the gripper's way; got .* mm off its path"):
        simulate_rope(calm, (("obstacle", 0.02),), 5, 1.0, 30)


def test_a_gripper_that_is_kept_from_its_path_is_no_data() -> None:
    time, path = STEP * np.arange(3), np.zeros((3, 6))
    kept = path.copy()
    kept[2, :3] = (0.0, 0.03, 0.04)
    check_gripper(Record(time, np.zeros((3, 30, 3)), path + 5e-4, path), "ep000")
    with pytest.raises(DivergenceError, match="ep000: what is hidden stands in the gripper's way; got 50.0 mm"):
        check_gripper(Record(time, np.zeros((3, 30, 3)), kept, path), "ep000")
