"""extensions.yaml is as strict as twin.yaml: what nobody reads is refused, and the message names the file."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import yaml
from report_cases import drag, rope

from pred_core.effects import effect_of
from pred_core.errors import TwinError
from pred_core.springmass import SpringMass
from pred_core.springmass.parameters import added_by
from pred_core.twin import Twin


def written(path: Path, **changes: Any) -> Path:
    """A twin with drag, its one entry changed; None takes a key away."""
    rope().replace(extensions=drag()).save(path)
    (entry,) = yaml.safe_load((path / "extensions.yaml").read_text())
    entry = {k: v for k, v in {**entry, **changes}.items() if v is not None}
    (path / "extensions.yaml").write_text(yaml.safe_dump([entry]))
    return path


def test_what_was_saved_is_what_is_read(tmp_path: Path) -> None:
    twin = Twin.load(written(tmp_path))
    assert twin.extensions == drag() and twin.extensions[0].source == str(tmp_path / "extensions.yaml")
    assert effect_of(twin.extensions[0]).id == "drag_linear"
    assert Twin.load(written(tmp_path, evidence=None)).extensions == drag()


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"foo": 3}, "unknown key 'foo'. known: evidence, id, parameters, version"),
        ({"versoin": 1}, "unknown key 'versoin'. did you mean 'version'?"),
        ({"id": None}, "missing key 'id'"),
        ({"version": None}, "missing key 'version'"),
        ({"version": 1.7}, "version; got 1.7; allowed: a whole number"),
        ({"id": 3}, "id; got 3"),
        ({"parameters": [1.0]}, "malformed entry"),
        ({"parameters": {"coefficient": 0.5}}, "'coefficient' of drag_linear; got 0.5; allowed: a list of numbers"),
        ({"parameters": {"coefficient": ["0.5"]}}, "'coefficient' of drag_linear; got ['0.5']"),
    ],
)
def test_an_entry_is_read_strictly(tmp_path: Path, changes: dict[str, Any], said: str) -> None:
    path = written(tmp_path, **changes)
    with pytest.raises(TwinError) as refused:
        Twin.load(path)
    assert str(refused.value).startswith(f"{path}/extensions.yaml: ") and said in str(refused.value)


def test_a_file_that_is_no_list_is_refused(tmp_path: Path) -> None:
    path = written(tmp_path)
    (path / "extensions.yaml").write_text("id: drag_linear\n")
    with pytest.raises(TwinError, match="extensions.yaml: not a list of entries; allowed: each with id, version"):
        Twin.load(path)


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"id": "drag_lineer"}, "unknown effect 'drag_lineer'. did you mean 'drag_linear'?"),
        ({"version": 7}, "effect 'drag_linear': version; got 7; allowed: 1"),
        ({"parameters": {"coeficient": [1.0]}}, "effect 'drag_linear' has no parameter 'coeficient'. did you mean"),
        ({"parameters": {"coefficient": [-1.0]}}, "effect 'drag_linear': 'coefficient'; got -1.0; allowed: 0.0 to"),
    ],
)
def test_what_the_library_does_not_have_is_refused_with_its_file(
    tmp_path: Path, changes: dict[str, Any], said: str
) -> None:
    """By whoever is first: the simulator, or the choice of its substeps."""
    path = written(tmp_path, **changes)
    twin = Twin.load(path)
    for ask in (
        lambda: SpringMass(twin.body, twin.physics, twin.scene, extensions=twin.extensions),
        lambda: added_by(twin.body, twin.extensions),
    ):
        with pytest.raises(TwinError) as refused:
            ask()
        assert str(refused.value).startswith(f"{path}/extensions.yaml: ") and said in str(refused.value)
