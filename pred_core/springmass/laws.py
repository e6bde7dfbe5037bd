"""The laws of effects as C++ statements: each hook is called once with traced values and writes what it returns."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from pred_core.effects.algebra import Code, Traced, Vec3, lane_text
from pred_core.effects.effect import (
    BendContext,
    ContactContext,
    Effect,
    GripContext,
    ParticleContext,
    SlideContext,
    SpringContext,
)

NO_TANGENT = Vec3(0.0, 0.0, 0.0)
BASE_PARAMETERS = 4  # stiffness, damping, friction, bending_stiffness: a world's parameter row begins with them


def law_statements(effects: tuple[type[Effect], ...]) -> dict[str, str]:
    """C++ statements for every placeholder."""
    writers = {
        "force": ("@FORCE@", _force),
        "spring": ("@SPRING@", _spring),
        "contact": ("@CONTACT@", _contact),
        "bend_stiffness": ("@BEND_STIFFNESS@", _bend_stiffness),
    }
    parts: dict[str, list[str]] = {placeholder: [] for placeholder, _ in writers.values()}
    row = BASE_PARAMETERS
    for number, effect in enumerate(effects):
        for hook, (placeholder, write) in writers.items():
            if hook in effect.hooks:
                code = Code(f"{hook}{number}_")
                tail = write(code, _parameters(code, effect, row), effect)
                parts[placeholder] += [*code.lines, *tail]
        row += sum(q.size for q in effect.parameters)
    parts["@BEND@"] = _bends(effects)
    parts["@BOUNDARY@"], parts["@SLIDE@"] = _grips(effects)
    return {placeholder: "\n    ".join(lines) for placeholder, lines in parts.items()}


def end_twist(effects: tuple[type[Effect], ...]) -> str:
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
        tangent=_vector(code, *(f"tangents[3 * i + {k}]" for k in range(3))) if effect.reads_tangent else NO_TANGENT,
    )
    f = effect.force(p, at)
    return [f"f{k} += {lane_text(v)};" for k, v in zip("xyz", (f.x, f.y, f.z), strict=True)]


def _bend_stiffness(code: Code, p: dict[str, Any], effect: type[Effect]) -> list[str]:
    relative = effect.bend_stiffness(p, _value(code, "Lane(e[2])"), _value(code, "time"))
    return [f"weight += bending * e[0] * {lane_text(relative)};"]


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


def _grips(effects: tuple[type[Effect], ...]) -> tuple[list[str], list[str]]:
    """Displacements of held particles, and how the memories they may depend on move on."""
    place, slide, row, slot = [], [], BASE_PARAMETERS, 0
    for number, effect in enumerate(effects):
        if "boundary" in effect.hooks:
            kept = [f"grip_memory[{slot + k} * N + held[2 * entry]]" for k in range(effect.grip_memory)]
            code = Code(f"boundary{number}_")
            tail = _boundary(code, _parameters(code, effect, row), effect, kept)
            place += [*code.lines, *tail]
            if kept:
                code = Code(f"slide{number}_")
                tail = _slide(code, _parameters(code, effect, row), effect, kept)
                slide += [*code.lines, *tail]
        slot += effect.grip_memory
        row += sum(q.size for q in effect.parameters)
    return place, ["@PULL@", *slide] if slide else []


def _axes(code: Code) -> tuple[Vec3, Vec3, Vec3]:
    w, x, y, z = (_value(code, n) for n in ("qw", "qx", "qy", "qz"))
    return (
        Vec3(1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y + w * z), 2.0 * (x * z - w * y)),
        Vec3(2.0 * (x * y - w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z + w * x)),
        Vec3(2.0 * (x * z + w * y), 2.0 * (y * z - w * x), 1.0 - 2.0 * (x * x + y * y)),
    )


def _slide(code: Code, p: dict[str, Any], effect: type[Effect], kept: list[str]) -> list[str]:
    at = SlideContext(
        pull=_vector(code, "pull_x", "pull_y", "pull_z"),
        mass=_value(code, "pulled_mass"),
        axes=_axes(code),
        substep=_value(code, "Lane(h)"),
        time=_value(code, "time"),
        memory=tuple(_value(code, place) for place in kept),
    )
    memory = effect.slide(p, at)
    return [f"{place} = lane_select(on, {lane_text(v)}, {place});" for place, v in zip(kept, memory, strict=True)]


def _boundary(code: Code, p: dict[str, Any], effect: type[Effect], kept: list[str]) -> list[str]:
    axes = _axes(code)
    speed = [code.emit(f"(g1[{k}] - g0[{k}]) * m.inverse_period") for k in range(3)]
    place = [code.emit(f"beta * g0[{k}] + alpha * g1[{k}]") for k in range(3)]
    at = GripContext(
        position=Vec3(*place) + _vector(code, "rx", "ry", "rz"),
        velocity=Vec3(*speed),
        lever=_vector(code, "lx", "ly", "lz"),
        axes=axes,
        time=_value(code, "time"),
        memory=tuple(_value(code, place) for place in kept),
    )
    d = effect.boundary(p, at)
    return [f"r{k} += {lane_text(v)};" for k, v in zip("xyz", (d.x, d.y, d.z), strict=True)]


def _bends(effects: tuple[type[Effect], ...]) -> list[str]:
    """Moments along the directors; effects' memory slots follow the two of the curvature and are all read first."""
    kept, laws, slot, value_slot = [], [], 0, 0
    for number, effect in enumerate(effects):
        places = [f"memory[4 * K + (2 + {slot + k}) * B + b]" for k in range(effect.bend_memory)]
        kept += [f"const Lane kept{number}_{k} = lane_select(fresh > zero, zero, {p});" for k, p in enumerate(places)]
        handed = range(value_slot, value_slot + effect.line_values)
        kept += [f"const Lane handed{number}_{k} = handed[{n}];" for k, n in enumerate(handed)]
        places += [f"handed[{n}]" for n in handed]
        slot += effect.bend_memory
        value_slot += effect.line_values
        if "bend" in effect.hooks:
            code = Code(f"bend{number}_")
            p, at = _bend(code, effects, number)
            if "rest_shape" in effect.hooks:
                others = [n for n, e in enumerate(effects) if n != number and "rest_shape" in e.hooks]
                shapes = [effects[n].rest_shape(*_bend(code, effects, n)) for n in others]
                at = replace(at, rest=(sum((s[0] for s in shapes), 0.0), sum((s[1] for s in shapes), 0.0)))
            first, second, memory = effect.bend(p, at)
            laws += [*code.lines, f"moment1 += {lane_text(first)}; moment2 += {lane_text(second)};"]
            laws += [f"{place} = {lane_text(value)};" for place, value in zip(places, memory, strict=True)]
    return kept + laws


def _bend(code: Code, effects: tuple[type[Effect], ...], number: int) -> tuple[dict[str, Any], BendContext]:
    """Parameters and context of one effect's bend hooks."""
    row = BASE_PARAMETERS + sum(q.size for e in effects[:number] for q in e.parameters)
    first = sum(e.line_values for e in effects[:number])
    values = effects[number].line_values
    at = BendContext(
        curvature=(_value(code, "k1"), _value(code, "k2")),
        change=(_value(code, "change1"), _value(code, "change2")),
        weight=_value(code, "weight"),
        length=_value(code, "Lane(e[1])"),
        bends=_value(code, "line_bends"),
        substep=_value(code, "Lane(h)"),
        arc=_value(code, "Lane(e[2])"),
        time=_value(code, "time"),
        memory=tuple(_value(code, f"kept{number}_{k}") for k in range(effects[number].bend_memory)),
        handed=tuple(_value(code, f"handed{number}_{k}") for k in range(values)),
        arrived=tuple(_value(code, f"arrived[{first + k}]") for k in range(values)),
        first_held=_value(code, "first_held"),
        last_held=_value(code, "last_held"),
    )
    return _parameters(code, effects[number], row), at
