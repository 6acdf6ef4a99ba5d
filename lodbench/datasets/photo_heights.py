"""What the altitude that a photo states is above, sea level or the ellipsoid, as it or its maker says."""

from __future__ import annotations

from lodbench.datasets.photo_metadata import PhotoMetadata

_AUTEL, _PARROT, _SKYDIO = "AUTEL", "PARROT", "SKYDIO"
# Parrot: "with reference to the WGS84 ellipsoid", on other models the EGM96 geoid (embedded photo metadata).
_ELLIPSOIDAL_PARROTS = "anafiai"
# What Pix4D's VertCS says beside codes of EPSG.
_ELLIPSOIDAL = "ellipsoidal"


def is_above_ellipsoid(photo: PhotoMetadata) -> bool:
    """Tells whether a photo's altitude is above the WGS 84 ellipsoid, and not above sea level.

    So it is where an RTK receiver measured it, where XMP says so (``VertCS``), and on Parrot's Anafi Ai.
    Autel's drones write ``VertCS`` of heights above sea level, too, and are not believed.
    """
    if photo.has_rtk:
        return True
    if _is_by(photo, _PARROT) and _plain(photo.model).startswith(_ELLIPSOIDAL_PARROTS):
        return True
    return photo.vertical_reference.lower() == _ELLIPSOIDAL and not _is_by(photo, _AUTEL)


def height_doubt(photo: PhotoMetadata) -> str:
    """Returns why an altitude that is not known to be above the ellipsoid may be; "" for no reason."""
    if is_above_ellipsoid(photo):
        return ""
    if photo.is_single_point:
        return "an RTK receiver without corrections, RtkFlag 16"
    if _is_by(photo, _AUTEL):
        return "Autel's drones differ"
    if _is_by(photo, _SKYDIO) and not photo.vertical_reference:
        return "Skydio's drones differ"
    return "GPSAltitudeRef changed its meaning with EXIF 3.0" if photo.is_exif3_height else ""


def _is_by(photo: PhotoMetadata, maker: str) -> bool:
    return photo.make.upper().startswith(maker)


def _plain(name: str) -> str:
    return "".join(letter for letter in name.lower() if letter.isalnum())
