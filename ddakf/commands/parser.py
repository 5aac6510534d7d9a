"""Parser of the command line: an error is one sentence of the command that the arguments belong to."""

from __future__ import annotations

import argparse
from collections.abc import Iterable
from typing import NoReturn

from ddakf.errors import nearest

MISUSED = 2  # exit status
_EXPECTED = {int: "a whole number", float: "a number"}  # by type of an argument


class Parser(argparse.ArgumentParser):
    """argparse's parser, except for its errors. Parsers of sub-commands are of the same class."""

    def parse_known_args(self, args=None, namespace=None):
        """Refuses unknown arguments itself: argparse would leave them to the top-level parser, whose usage explains nothing."""
        parsed, unknown = super().parse_known_args(args, namespace)
        if unknown:
            self.error(self._sentence_about(unknown[0].partition("=")[0]))
        return parsed, unknown

    def error(self, message: str) -> NoReturn:
        """Ends the program with one sentence."""
        self.exit(MISUSED, f"{self.prog}: {message} (see {self.prog} --help)\n")

    def _check_value(self, action: argparse.Action, value) -> None:
        if action.choices is not None and value not in action.choices:
            hint = nearest(value, action.choices)
            raise argparse.ArgumentError(action, f"expected {_either(action.choices)}, got {value!r}{hint}")

    def _get_value(self, action: argparse.Action, text: str):
        try:
            return super()._get_value(action, text)
        except argparse.ArgumentError:
            if action.type not in _EXPECTED:
                raise
            raise argparse.ArgumentError(action, f"expected {_EXPECTED[action.type]}, got {text!r}") from None

    def _sentence_about(self, argument: str) -> str:
        if not argument.startswith("-"):
            return f"unexpected argument {argument!r}"
        options = [option for action in self._actions for option in action.option_strings]
        return f"unknown option {argument}{nearest(argument, options)}"


def _either(choices: Iterable) -> str:
    *others, last = map(str, choices)
    return f"{', '.join(others)} or {last}" if others else last
