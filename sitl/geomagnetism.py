"""The earth's magnetic field at a place, from the World Magnetic Model 2025.

Source: WMM2025 of NOAA and the British Geological Survey, as the library pygeomag computes it. PX4 looks declination
and inclination up in tables of the same model, so a field from elsewhere would turn its heading.
"""

from __future__ import annotations

import math

from sitl.errors import UsageError

YEAR = 2026.0
"""Date of the field, decimal years: fixed, so that a flight is the same tomorrow."""

_MODEL = 2025
_NANOTESLA_PER_GAUSS = 1e5


def earth_field_gauss(lat_deg: float, lon_deg: float, alt_m: float, year: float = YEAR) -> tuple[float, float, float]:
    """Magnetic field north, east, down, gauss.

    Args:
        lat_deg, lon_deg: of the place. alt_m: above mean sea level. year: decimal, 2025.0 to 2030.0.
    """
    from pygeomag import GeoMag

    result = GeoMag(base_year=_MODEL).calculate(glat=lat_deg, glon=lon_deg, alt=alt_m * 1e-3, time=year)
    north, east, down = (float(value) / _NANOTESLA_PER_GAUSS for value in (result.x, result.y, result.z))
    return north, east, down


def home_of(text: str) -> tuple[float, float, float]:
    """A place as people write it: `47.3977,8.5456,488`.

    Args:
        text: latitude and longitude in degrees, height above mean sea level in m.

    Raises:
        UsageError: it is none, or near a pole, where neither compass nor flat earth mean anything.
    """
    try:
        lat, lon, alt = (float(part) for part in text.split(","))
    except ValueError:
        lat = lon = alt = math.nan
    if not (abs(lat) <= 80.0 and abs(lon) <= 180.0 and -500.0 <= alt <= 9000.0):
        raise UsageError(
            f"--home {text}: give latitude (within 80 degrees), longitude and height above the sea in m, such as "
            "47.397742,8.545594,488"
        )
    return lat, lon, alt
