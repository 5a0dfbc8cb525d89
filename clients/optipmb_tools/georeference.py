"""Place of the world frame of a data set on the globe, as `--origin` names it; imports the tracker."""

from optipmb import Georeference, ParameterError
from optipmb_tools.files import DatasetError

__all__ = ["Georeference", "georeference_of"]


def georeference_of(origin: float | str) -> Georeference:
    """Return the place that an option names.

    Raises:
        DatasetError: It names none.
    """
    try:
        return Georeference.parse(str(origin))
    except ParameterError as error:
        raise DatasetError(f"--{error.path}", error.expected, error.received) from error
