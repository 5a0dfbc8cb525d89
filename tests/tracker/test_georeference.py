"""Positions on the globe, against PROJ 9.5.1 (topocentric, cart) and its geodesic azimuths."""

from __future__ import annotations

import numpy as np
import pytest

from optipmb import Georeference, ParameterError

# Origin, heading of x, point and yaw in the world; latitude, longitude, height and heading by PROJ.
CASES = [
    ((48.265013, 11.67123, 489.0), 90.0, (-299.21, -21.77, 47.28), -2.14,
     (48.264817164519, 11.667200174338, 536.28704175, 212.6100)),
    ((48.265013, 11.67123, 489.0), 90.0, (18948.75, -6398.81, 12.15), -0.46,
     (48.207189042102, 11.926150465669, 532.45574964, 116.5462)),
    ((0.0, 0.0, 0.0), 0.0, (140.02, -265.32, 17.51), 0.3,
     (0.001266294641, 0.002383403567, 17.51706571, 342.8113)),
    ((0.0, 0.0, 0.0), 0.0, (19701.21, 3444.17, 36.44), 0.23,
     (0.178170098833, -0.030939325749, 68.00192087, 346.8219)),
    ((-33.9, 151.2, 30.0), 213.4, (-143.81, 263.29, 38.36), -1.18,
     (-33.900224229183, 151.203232348667, 68.36704838, 281.0072)),
    ((-33.9, 151.2, 30.0), 213.4, (-19144.01, 5788.5, 2.37), -0.58,
     (-33.784527339507, 151.365960113525, 63.75393270, 246.5392)),
    ((69.6, -179.95, 120.0), 90.0, (86.68, 287.21, 9.43), 1.5,
     (69.602574493325, -179.947772498690, 129.43703995, 4.0584)),
    ((69.6, -179.95, 120.0), 90.0, (-3780.53, 19639.44, 21.69), 2.88,
     (69.776015176756, 179.952051431821, 172.97848378, 284.8962)),
    ((89.9, 179.9, 0.0), -45.0, (291.12, -72.47, 34.86), 0.25,
     (89.902291979900, 179.088273891059, 34.86703188, 299.8643)),
    ((89.9, 179.9, 0.0), -45.0, (-3345.8, 19718.15, 3.84), 2.82,
     (89.733045365081, 157.053427112851, 35.09187722, 130.5793)),
]  # fmt: skip
METRES = 111_320.0  # of a degree of latitude


@pytest.mark.parametrize(("origin", "x_heading", "point", "yaw", "expected"), CASES)
def test_positions_and_headings_are_those_of_proj(
    origin: tuple[float, float, float], x_heading: float, point: tuple[float, ...], yaw: float, expected: list[float]
) -> None:
    """Within a micrometre and 0.01 degrees, up to 20 km away, over the date line and near a pole; and back."""
    place = Georeference(origin, x_heading)
    found = place.to_geographic([point], [yaw])
    lat, lon, alt, heading = (float(one[0]) for one in found)
    assert abs(lat - expected[0]) * METRES < 1e-6
    assert abs(lon - expected[1]) * METRES * np.cos(np.radians(lat)) < 1e-6
    assert abs(alt - expected[2]) < 1e-6
    assert abs((heading - expected[3] + 180.0) % 360.0 - 180.0) < 0.01
    np.testing.assert_allclose(place.to_world(*found[:3]), [point], atol=1e-6)


def test_what_is_far_away_has_no_place() -> None:
    """Coordinates of a map projection are no world around an origin; the others of the same call have theirs."""
    found = Georeference((48.0, 11.0, 500.0)).to_geographic(
        [(690_000.0, 5_330_000.0, 0.0), (0.0, 0.0, 0.0)], [0.0, 0.0]
    )
    assert np.isnan([one[0] for one in found]).all()
    assert [float(one[1]) for one in found] == pytest.approx([48.0, 11.0, 500.0, 90.0])


def test_a_position_without_height_is_at_that_of_the_origin() -> None:
    """Two metres to the east, of a detector that gives latitude and longitude alone."""
    place = Georeference((48.0, 11.0, 500.0))
    lat, lon, *_ = place.to_geographic([(2.0, 0.0, 0.0)])
    np.testing.assert_allclose(place.to_world(lat, lon), [(2.0, 0.0, 0.0)], atol=1e-6)


@pytest.mark.parametrize("text", ["48,11", "48,11,0,0,0", "north", "91,11,0", "48,181,0", "48,11,nan", "48,11,0,361"])
def test_a_wrong_origin_is_refused(text: str) -> None:
    """With the name of the number."""
    with pytest.raises(ParameterError, match="origin"):
        Georeference.parse(text)
