"""Builds the native Warp kernel for a set of effects: traces their laws and fills the source's placeholders."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from typing import Any

import warp as wp

from pred_core.effects.algebra import Code, Traced, Vec3, lane_text
from pred_core.effects.effect import (
    BendContext,
    ContactContext,
    Effect,
    GripContext,
    ParticleContext,
    SpringContext,
)
from pred_core.springmass import source, source_bending, source_contact

SIMD_LANES = 16  # worlds side by side on CPU
FEW_WORLDS = 4  # fewer run one after the other, eight springs side by side: quicker than sixteen lanes
wp.config.log_level = 30
BASE_PARAMETERS = 4  # stiffness, damping, friction, bending_stiffness


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
    chains: wp.array(dtype=wp.int32)  # type: ignore[valid-type]
    particles: wp.int32
    spring_count: wp.int32
    bend_count: wp.int32
    grippers: wp.int32
    held_count: wp.int32
    fixture_count: wp.int32
    pair_count: wp.int32
    chain_count: wp.int32
    blocks: wp.int32
    parameter_count: wp.int32
    memory_count: wp.int32
    periods: wp.int32
    substeps: wp.int32
    masked: wp.int32
    has_ground: wp.int32
    loose: wp.int32  # some line is held at neither end
    stage: wp.int32
    stage_sub: wp.int32
    substep: wp.float32  # [s]
    inverse_substeps: wp.float32
    inverse_period: wp.float32  # [1/s]
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
    inverse_mass: wp.array(dtype=wp.float32)  # type: ignore[valid-type]
    parameters: wp.array(dtype=wp.float32)  # type: ignore[valid-type]
    spring_mask: wp.array(dtype=wp.float32)  # type: ignore[valid-type]
    held_mask: wp.array(dtype=wp.float32)  # type: ignore[valid-type]
    held_offset: wp.array(dtype=wp.float32)  # type: ignore[valid-type]
    held_lever: wp.array(dtype=wp.float32)  # type: ignore[valid-type]
    grips: wp.array(dtype=wp.float32)  # type: ignore[valid-type]
    frame_grip: wp.array(dtype=wp.float32)  # type: ignore[valid-type]
    memory: wp.array(dtype=wp.float32)  # type: ignore[valid-type]
    time: wp.array(dtype=wp.float32)  # type: ignore[valid-type]
    clock: wp.array(dtype=wp.int32)  # type: ignore[valid-type]
    trajectory_out: wp.array(dtype=wp.float32)  # type: ignore[valid-type]


def parameter_count(effects: tuple[type[Effect], ...]) -> int:
    """Length of a world's parameter row: the base ones, then each effect's in order."""
    return BASE_PARAMETERS + sum(q.size for e in effects for q in e.parameters)


def stride(lanes: int, staged: bool) -> int:
    """Floats a particle takes per lane: four where one world runs eight springs at a time, else three."""
    return 4 if lanes == 1 and not staged else 3


def kernel_text(effects: tuple[type[Effect], ...], lanes: int, staged: bool) -> str:
    """The C++ of the native function, every placeholder filled."""
    framed = any("bend" in e.hooks for e in effects)
    eight = stride(lanes, staged) == 4
    text = "\n".join(
        (source.PRELUDE, source_bending.FRAME if framed else "", source.SPRING, source.SPRING_EIGHT if eight else "",
         source_bending.BEND, source_contact.CONTACT, source_contact.SELF_COLLISION, source_contact.PARTICLE,
         source_contact.HELD, source.STAGED if staged else source.FUSED)
    )  # fmt: skip
    parts = {
        "@SPRING_LAW@": source.SPRING_LAW,
        "@VECTOR_FUNCTIONS@": source.VECTOR_FUNCTIONS,
        "@SCALAR@": "1" if lanes == 1 else "0",
        "@LANES@": str(lanes),
        "@STRIDE@": str(stride(lanes, staged)),
        "@ALL_SPRINGS@": source.ALL_SPRINGS_EIGHT if eight else source.ALL_SPRINGS,
        "@ALL_BENDS@": source_bending.ALL_BENDS_FRAMED if framed else source_bending.ALL_BENDS,
        "@ONE_BEND@": source_bending.ONE_BEND_FRAMED if framed else source_bending.ONE_BEND,
        "@BEND_FRAME@": source_bending.BEND_FRAME if framed else "",
        "@BEND_MOMENT@": source_bending.BEND_MOMENT if framed else "",
        "@END_TWIST@": _end_twist(effects),
    }
    for placeholder, statements in (*parts.items(), *_laws(effects).items()):
        text = text.replace(placeholder, statements)
    return text


@lru_cache(maxsize=64)
def build(effects: tuple[type[Effect], ...], lanes: int, staged: bool) -> Callable[..., Any]:
    """The kernel `k(model, worlds)`; grid (blocks,) fused, (blocks, elements) staged. Compiled once, cached."""

    def advance(m: Model, w: Worlds, block: wp.int32, element: wp.int32): ...

    native: Any = wp.func_native(kernel_text(effects, lanes, staged))(advance)

    if staged:

        def substep_stage(m: Model, w: Worlds):
            block, element = wp.tid()  # type: ignore[misc]
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
        "bend_stiffness": ("@BEND_STIFFNESS@", _bend_stiffness),
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


def _end_twist(effects: tuple[type[Effect], ...]) -> str:
    """The sum of the parameters by which effects turn the far end of a line [rad]."""
    places, row = ["zero"], BASE_PARAMETERS
    for effect in effects:
        for q in effect.parameters:
            if q.name == effect.end_twist:
                places.append(f"P[{row}]")
            row += q.size
    return " + ".join(places)


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
    return [f"f{k} += {lane_text(v)};" for k, v in zip("xyz", (f.x, f.y, f.z), strict=True)]


def _bend_stiffness(code: Code, p: dict[str, Any], effect: type[Effect]) -> list[str]:
    relative = effect.bend_stiffness(p, _value(code, "Lane(e[2])"))
    return [f"weight += bending * e[0] * {relative.name};"]


def _spring(code: Code, p: dict[str, Any], effect: type[Effect]) -> list[str]:
    at = SpringContext(
        length=_value(code, "length"),
        rest_length=_value(code, "Lane(spring(1))"),
        rate=_value(code, "rate"),
        stiffness=_value(code, "k"),
        damping=_value(code, "c"),
        arc=_value(code, "Lane(spring(4))"),
        time=_value(code, "time"),
    )
    return [f"tension += {lane_text(effect.spring(p, at))};"]


def _contact(code: Code, p: dict[str, Any], effect: type[Effect]) -> list[str]:
    at = ContactContext(
        position=_vector(code, "x", "y", "z"),
        velocity=_vector(code, "vx", "vy", "vz"),
        friction=_value(code, "mu0"),
        time=_value(code, "time"),
    )
    friction, height = effect.contact(p, at)
    lines = [f"mu = lane_max(mu + {friction.name}, zero);"] if isinstance(friction, Traced) else []
    return lines + ([f"ground += {height.name};"] if isinstance(height, Traced) else [])


def _boundary(code: Code, p: dict[str, Any], effect: type[Effect]) -> list[str]:
    w, x, y, z = (_value(code, n) for n in ("qw", "qx", "qy", "qz"))
    axes = (
        Vec3(1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y + w * z), 2.0 * (x * z - w * y)),
        Vec3(2.0 * (x * y - w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z + w * x)),
        Vec3(2.0 * (x * z + w * y), 2.0 * (y * z - w * x), 1.0 - 2.0 * (x * x + y * y)),
    )
    speed = [code.emit(f"(g1[{k}] - g0[{k}]) * m.inverse_period") for k in range(3)]
    place = [code.emit(f"beta * g0[{k}] + alpha * g1[{k}]") for k in range(3)]
    at = GripContext(
        position=Vec3(*place) + _vector(code, "rx", "ry", "rz"),
        velocity=Vec3(*speed),
        lever=_vector(code, "lx", "ly", "lz"),
        axes=axes,
        time=_value(code, "time"),
    )
    d = effect.boundary(p, at)
    return [f"r{k} += {lane_text(v)};" for k, v in zip("xyz", (d.x, d.y, d.z), strict=True)]


def _bend(code: Code, p: dict[str, Any], effect: type[Effect], slot: int) -> list[str]:
    """Moments along the directors; an effect's memory slots follow the two of the curvature."""
    places = [f"memory[4 * K + (2 + {slot + k}) * B + b]" for k in range(effect.bend_memory)]
    held = [code.emit(f"lane_select(fresh > zero, zero, {place})") for place in places]
    at = BendContext(
        curvature=(_value(code, "k1"), _value(code, "k2")),
        change=(_value(code, "change1"), _value(code, "change2")),
        weight=_value(code, "weight"),
        bends=_value(code, "line_bends"),
        substep=_value(code, "Lane(h)"),
        arc=_value(code, "Lane(e[2])"),
        memory=tuple(held),
    )
    first, second, memory = effect.bend(p, at)
    kept = [f"{place} = {lane_text(value)};" for place, value in zip(places, memory, strict=True)]
    return [f"moment1 += {lane_text(first)}; moment2 += {lane_text(second)};", *kept]


@wp.kernel(enable_backward=False)
def _tick(clock: wp.array(dtype=wp.int32)):  # type: ignore[valid-type]
    clock[0] = clock[0] + 1


def launch_staged(
    run: Any, model: Any, record: Any, periods: int, device: str, sizes: tuple[int, ...]
) -> None:
    """Launches of springs, bends and pairs, particles and held a substep; `sizes` are their element counts.

    The schedule of CUDA, where one period is recorded as a graph and replayed; on CPU the same launches run
    one by one, which is how the schedule is tested.
    """

    def one_period() -> None:
        for sub in range(model.substeps):
            for stage, size in enumerate(sizes):
                if size:
                    model.stage, model.stage_sub = stage, sub
                    wp.launch(run, dim=(model.blocks, size), inputs=[model, record], device=device)
        model.stage = len(sizes)
        wp.launch(run, dim=(model.blocks, 3 * model.particles), inputs=[model, record], device=device)
        wp.launch(_tick, dim=1, inputs=[record.clock], device=device)

    if not wp.get_device(device).is_cuda:
        for _ in range(periods):
            one_period()
        return
    with wp.ScopedCapture(device=device) as capture:
        one_period()
    for _ in range(periods):
        wp.capture_launch(capture.graph)
