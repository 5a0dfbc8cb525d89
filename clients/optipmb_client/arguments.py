"""What the option parser does not know: several values after one flag, and a value that may be left out.

`--sequences 0000 0002` is the first, `--ray` the second.
"""

import re
from collections.abc import Iterable, Sequence


def filled(arguments: Sequence[str], option: str, values: re.Pattern[str], default: str) -> list[str]:
    """Rewrite `--x` as `--x=DEFAULT` where none of the values that the option takes follows, and leave all else."""
    end = arguments.index("--") if "--" in arguments else len(arguments)
    return [
        f"{one}={default}"
        if one == option and place < end and not values.fullmatch("".join(arguments[place + 1 : place + 2]))
        else one
        for place, one in enumerate(arguments)
    ]


def spread(arguments: Sequence[str], options: Iterable[str]) -> list[str]:
    """Rewrite `--x a b,c` as `--x a --x b --x c` for each of the `options`, and leave everything else as it is.

    The values of an option are the arguments after it up to the next one that begins with a dash. A flag without a
    value stays alone, for the parser to complain about.
    """
    many = set(options)
    result: list[str] = []
    flag = ""
    for position, argument in enumerate(arguments):
        if argument == "--":
            return [*result, *arguments[position:]]
        name, equals, value = argument.partition("=")
        if name in many:
            flag = name
            following = arguments[position + 1 : position + 2]
            if equals:
                result += _pairs(flag, value)
            elif not following or following[0].startswith("-"):
                result.append(flag)
        elif argument.startswith("-"):
            flag = ""
            result.append(argument)
        else:
            result += _pairs(flag, argument) if flag else [argument]
    return result


def _pairs(flag: str, values: str) -> list[str]:
    names = [name for name in values.split(",") if name]
    return [part for name in names or [""] for part in (flag, name)]
