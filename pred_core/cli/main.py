"""`pred COMMAND ...`: one module a command, imported only when it is asked for."""

from __future__ import annotations

import argparse
import importlib
import sys
from collections.abc import Sequence
from types import ModuleType
from typing import NoReturn

from pred_core.errors import PredError, nearest

COMMANDS: tuple[str, ...] = ("info", "convert", "track", "identify", "train", "diagnose", "evaluate", "plan", "plant")
INTERRUPTED = 130  # the shell's code for SIGINT
BAD_INPUT = 2
_INTERRUPTED = "run the same command again to go on where it stopped"
_INTERRUPTED_IN = {
    "identify": "run the same command again: the search goes on where it stopped, the refinement starts again",
    "train": "run the same command again with --resume to go on from the last checkpoint",
    "info": "nothing was changed",
}  # commands that do not go on exactly where they stopped


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command. Returns the exit code: 0 done, 2 bad input (one line on stderr), 130 interrupted."""
    arguments = list(sys.argv[1:] if argv is None else argv)
    name = next((a for a in arguments if not a.startswith("-")), None)
    try:
        if name is not None and name not in COMMANDS:
            raise PredError(f"unknown command '{name}'", next_step=nearest(name, COMMANDS))
        chosen = COMMANDS if name is None else (name,)
        parser = _parser({c: _module(c) for c in chosen})
        _check_options(arguments, parser)
        args = parser.parse_args(arguments)
        return int(args.run(args))
    except PredError as error:
        print(f"pred: {error}", file=sys.stderr)
        return BAD_INPUT
    except OSError as error:
        where = error.filename or "a file"
        print(f"pred: {where}: {error.strerror or error}. Give a path that can be read and written.", file=sys.stderr)
        return BAD_INPUT
    except KeyboardInterrupt:
        print(f"pred: interrupted; {_INTERRUPTED_IN.get(name or '', _INTERRUPTED)}", file=sys.stderr)
        return INTERRUPTED


def _module(name: str) -> ModuleType:
    return importlib.import_module(f"pred_core.cli.{name}_command")


class _Parser(argparse.ArgumentParser):
    """argparse whose errors are one line like every other."""

    def error(self, message: str) -> NoReturn:
        command = self.prog.removeprefix("pred").strip()
        raise PredError(f"{command}: {message}".removeprefix(": "), next_step=f"See {self.prog} --help")


def _parser(modules: dict[str, ModuleType]) -> argparse.ArgumentParser:
    parser = _Parser(prog="pred", description="Track, predict, diagnose and drive soft objects.")
    subparsers = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")
    for name, module in modules.items():
        sub = subparsers.add_parser(name, help=module.HELP, description=module.HELP)
        module.configure(sub)
        sub.set_defaults(run=module.run)
    return parser


def _check_options(arguments: Sequence[str], parser: argparse.ArgumentParser) -> None:
    """Raise PredError with the nearest name for an option that no command at hand has; argparse names only the word."""
    known = _options(parser)
    for word in arguments:
        if word == "--":
            return
        option = word.split("=", 1)[0]
        if word.startswith("--") and not any(o.startswith(option) for o in known):  # it may be cut short
            raise PredError(f"unknown option '{option}'", next_step=nearest(option, known))


def _options(parser: argparse.ArgumentParser) -> set[str]:
    """Every long option of a parser and of the commands in it."""
    found = {o for o in parser._option_string_actions if o.startswith("--")}
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            found = found.union(*map(_options, action.choices.values()))
    return found


if __name__ == "__main__":
    sys.exit(main())
