"""Options that take several values after one flag, which the option parser does not know: `--sequences 0000 0002`."""

from collections.abc import Iterable, Sequence

__all__ = ["spread"]


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
