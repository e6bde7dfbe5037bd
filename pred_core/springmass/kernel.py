"""Builds the native Warp kernel for a set of effects: traces their laws and fills the source's placeholders."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from typing import Any

import warp as wp

from pred_core.effects.algebra import Code, Traced, Vec3
from pred_core.effects.effect import (
    BendContext,
    ContactContext,
    Effect,
    GripContext,
    ParticleContext,
    SpringContext,
)
from pred_core.springmass import source

SIMD_LANES = 16  # worlds side by side on CPU
wp.config.quiet = True
wp.config.log_level = 30
BASE_PARAMETERS = 4  # stiffness, damping, friction, bending_stiffness
FRAME_START = "fresh = m.time == 0.0f && period == 0 && sub == 0; if (B) start_frame(period, alpha);"


@wp.struct
class Model:
    """What all worlds share; see `source.PRELUDE` for shapes."""

    springs: wp.array(dtype=wp.int32)  # type: ignore[valid-type]
    spring_data: wp.array(dtype=wp.float32)  # type: ignore[valid-type]
    bends: wp.array(dtype=wp.int32)  # type: ignore[valid-type]
    bend_data: wp.array(dtype=wp.float32)  # type: ignore[valid-type]
    particle_data: wp.array(dtype=wp.float32)  # type: ignore[valid-type]
    fixture_shape: wp.array(dtype=wp.int32)  # type: ignore[valid-type]
    fixture_data: wp.array(dtype=wp.float32)  # type: ignore[valid-type]
    pairs: wp.array(dtype=wp.int32)  # type: ignore[valid-type]
    held: wp.array(dtype=wp.int32)  # type: ignore[valid-type]
    particles: wp.int32
    spring_count: wp.int32
    bend_count: wp.int32
    grippers: wp.int32
    held_count: wp.int32
    fixture_count: wp.int32
    pair_count: wp.int32
    parameter_count: wp.int32
    memory_count: wp.int32
    periods: wp.int32
    substeps: wp.int32
    masked: wp.int32
    has_ground: wp.int32
    stage: wp.int32
    stage_sub: wp.int32
    substep: wp.float32  # [s]
    inverse_substeps: wp.float32
    inverse_period: wp.float32  # [1/s]
    time: wp.float32  # [s] at the start of the call
    gravity_x: wp.float32
    gravity_y: wp.float32
    gravity_z: wp.float32
    ground: wp.float32  # [m]
    radius: wp.float32  # [m] particle
    pusher_radius: wp.float32  # [m]
    contact_distance: wp.float32  # [m]


@wp.struct
class Worlds:
    """What each world has of its own; innermost axis is the lane."""

    position: wp.array(dtype=wp.float32)  # type: ignore[valid-type]
    velocity: wp.array(dtype=wp.float32)  # type: ignore[valid-type]
    force: wp.array(dtype=wp.float32)  # type: ignore[valid-type]
    mass: wp.array(dtype=wp.float32)  # type: ignore[valid-type]
    parameters: wp.array(dtype=wp.float32)  # type: ignore[valid-type]
    spring_mask: wp.array(dtype=wp.float32)  # type: ignore[valid-type]
    held_mask: wp.array(dtype=wp.float32)  # type: ignore[valid-type]
    held_offset: wp.array(dtype=wp.float32)  # type: ignore[valid-type]
    grips: wp.array(dtype=wp.float32)  # type: ignore[valid-type]
    frame_grip: wp.array(dtype=wp.float32)  # type: ignore[valid-type]
    memory: wp.array(dtype=wp.float32)  # type: ignore[valid-type]
    clock: wp.array(dtype=wp.int32)  # type: ignore[valid-type]
    trajectory_out: wp.array(dtype=wp.float32)  # type: ignore[valid-type]


def parameter_count(effects: tuple[type[Effect], ...]) -> int:
    """Length of a world's parameter row: the base ones, then each effect's in order."""
    return BASE_PARAMETERS + sum(q.size for e in effects for q in e.parameters)


@lru_cache(maxsize=64)
def build(effects: tuple[type[Effect], ...], lanes: int, staged: bool) -> Callable[..., Any]:
    """The kernel `k(model, worlds)`; grid (blocks,) fused, (blocks, elements) staged. Compiled once, cached."""
    body = source.FUSED if not staged else source.STAGED
    framed = any("bend" in e.hooks for e in effects)
    text = "\n".join(
        (source.PRELUDE, source.FRAME if framed else "", source.SPRING, source.BEND, source.CONTACT, source.SELF_COLLISION, source.PARTICLE,
         source.HELD, body)
    )  # fmt: skip
    text = text.replace("@SCALAR@", "1" if lanes == 1 else "0").replace("@LANES@", str(lanes))
    text = text.replace("@BEND_FRAME@", source.BEND_FRAME if framed else "")
    text = text.replace("@BEND_MOMENT@", source.BEND_MOMENT if framed else "")
    text = text.replace("@BEND_START@", FRAME_START if framed else "")
    for placeholder, statements in _laws(effects).items():
        text = text.replace(placeholder, statements)

    def advance(m: Model, w: Worlds, block: wp.int32, element: wp.int32): ...

    native = wp.func_native(text)(advance)

    if staged:

        def substep_stage(m: Model, w: Worlds):
            block, element = wp.tid()
            native(m, w, block, element)

        entry = substep_stage
    else:

        def substeps_fused(m: Model, w: Worlds):
            native(m, w, wp.tid(), 0)

        entry = substeps_fused
    # One module per source text, so that adding an effect never recompiles or changes another kernel.
    return wp.kernel(entry, enable_backward=False, module="unique")


def _laws(effects: tuple[type[Effect], ...]) -> dict[str, str]:
    """C++ statements for every placeholder."""
    writers = {
        "force": ("@FORCE@", _force),
        "spring": ("@SPRING@", _spring),
        "contact": ("@CONTACT@", _contact),
        "boundary": ("@BOUNDARY@", _boundary),
    }
    parts: dict[str, list[str]] = {placeholder: [] for placeholder, _ in writers.values()}
    parts["@BEND@"] = []
    row, slot = BASE_PARAMETERS, 0
    for number, effect in enumerate(effects):
        for hook, (placeholder, write) in writers.items():
            if hook in effect.hooks:
                code = Code(f"{hook}{number}_")
                tail = write(code, _parameters(code, effect, row), effect)
                parts[placeholder] += [*code.lines, *tail]
        if "bend" in effect.hooks:
            code = Code(f"bend{number}_")
            tail = _bend(code, _parameters(code, effect, row), effect, slot)
            parts["@BEND@"] += [*code.lines, *tail]
            slot += effect.bend_memory
        row += sum(q.size for q in effect.parameters)
    return {placeholder: "\n    ".join(lines) for placeholder, lines in parts.items()}


def _parameters(code: Code, effect: type[Effect], row: int) -> dict[str, Any]:
    """The effect's parameters as places in the world's parameter row."""
    values: dict[str, Any] = {}
    for q in effect.parameters:
        values[q.name] = tuple(Traced(code, f"P[{row + k}]") for k in range(q.size))
        row += q.size
    return values


def _value(code: Code, name: str) -> Traced:
    return Traced(code, name)


def _vector(code: Code, *names: str) -> Vec3:
    return Vec3(*(Traced(code, n) for n in names))


def _force(code: Code, p: dict[str, Any], effect: type[Effect]) -> list[str]:
    at = ParticleContext(
        position=_vector(code, "x", "y", "z"),
        velocity=_vector(code, "vx", "vy", "vz"),
        mass=_value(code, "m_i"),
        arc=_value(code, "Lane(e[1])"),
        time=_value(code, "time"),
    )
    f = effect.force(p, at)
    return [f"fx += {f.x.name}; fy += {f.y.name}; fz += {f.z.name};"]


def _spring(code: Code, p: dict[str, Any], effect: type[Effect]) -> list[str]:
    at = SpringContext(
        length=_value(code, "length"),
        rest_length=_value(code, "Lane(e[1])"),
        rate=_value(code, "rate"),
        stiffness=_value(code, "k"),
        damping=_value(code, "c"),
        arc=_value(code, "Lane(e[4])"),
        time=_value(code, "time"),
    )
    return [f"tension += {effect.spring(p, at).name};"]


def _contact(code: Code, p: dict[str, Any], effect: type[Effect]) -> list[str]:
    at = ContactContext(
        position=_vector(code, "x", "y", "z"),
        velocity=_vector(code, "vx", "vy", "vz"),
        friction=_value(code, "mu0"),
        time=_value(code, "time"),
    )
    friction, height = effect.contact(p, at)
    lines = [f"mu += {friction.name};"] if isinstance(friction, Traced) else []
    return lines + ([f"ground += {height.name};"] if isinstance(height, Traced) else [])


def _boundary(code: Code, p: dict[str, Any], effect: type[Effect]) -> list[str]:
    w, x, y, z = (_value(code, n) for n in ("qw", "qx", "qy", "qz"))
    axes = (
        Vec3(1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y + w * z), 2.0 * (x * z - w * y)),
        Vec3(2.0 * (x * y - w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z + w * x)),
        Vec3(2.0 * (x * z + w * y), 2.0 * (y * z - w * x), 1.0 - 2.0 * (x * x + y * y)),
    )
    speed = [code.emit(f"(g1[{k}] - g0[{k}]) * m.inverse_period") for k in range(3)]
    at = GripContext(
        position=_vector(code, "x", "y", "z"),
        velocity=Vec3(*speed),
        lever=_vector(code, "lx", "ly", "lz"),
        axes=axes,
        time=_value(code, "time"),
    )
    d = effect.boundary(p, at)
    return [f"x += {d.x.name}; y += {d.y.name}; z += {d.z.name};"]


def _bend(code: Code, p: dict[str, Any], effect: type[Effect], slot: int) -> list[str]:
    """Moments in the director frame; memory slots of the effect follow the two of the curvature."""
    places = [f"memory[1 + (2 + {slot + k}) * B + b]" for k in range(effect.bend_memory)]
    held = [code.emit(f"(fresh ? zero : {place})") for place in places]
    at = BendContext(
        curvature=(_value(code, "k1"), _value(code, "k2")),
        change=(_value(code, "change1"), _value(code, "change2")),
        weight=_value(code, "weight"),
        bends=_value(code, "Lane((float)B)"),
        substep=_value(code, "Lane(h)"),
        arc=_value(code, "Lane(e[2])"),
        memory=tuple(held),
    )
    first, second, memory = effect.bend(p, at)
    kept = [f"{place} = {value.name};" for place, value in zip(places, memory, strict=True)]
    return [f"moment1 += {first.name}; moment2 += {second.name};", *kept]


@wp.kernel(enable_backward=False)
def _tick(clock: wp.array(dtype=wp.int32)):  # type: ignore[valid-type]
    clock[0] = clock[0] + 1


def launch_staged(
    run: Any, model: Any, record: Any, blocks: int, periods: int, substeps: int, device: str, sizes: tuple[int, ...]
) -> None:
    """Launches of springs, bends and pairs, particles and held a substep; `sizes` are their element counts.

    The schedule of CUDA, where one period is recorded as a graph and replayed; on CPU the same launches run
    one by one, which is how the schedule is tested.
    """

    def one_period() -> None:
        for sub in range(substeps):
            for stage, size in enumerate(sizes):
                if size:
                    model.stage, model.stage_sub = stage, sub
                    wp.launch(run, dim=(blocks, size), inputs=[model, record], device=device)
        model.stage = len(sizes)
        wp.launch(run, dim=(blocks, 3 * model.particles), inputs=[model, record], device=device)
        wp.launch(_tick, dim=1, inputs=[record.clock], device=device)

    if not wp.get_device(device).is_cuda:
        for _ in range(periods):
            one_period()
        return
    with wp.ScopedCapture(device=device) as capture:
        one_period()
    for _ in range(periods):
        wp.capture_launch(capture.graph)
