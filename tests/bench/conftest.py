import pytest

from tests.town import box_obj


@pytest.fixture(scope="session")
def city(tmp_path_factory):
    """A file of a few large boxes, wide enough to fill a drone's view."""
    boxes = [
        (x - 18, y - 15, x + 10 + (x * 7 + y) % 9, y + 14, 0, 10 + (3 * x + y) % 17)
        for x in range(-150, 151, 50)
        for y in range(-150, 151, 50)
    ]
    path = tmp_path_factory.mktemp("bench") / "boxes.obj"
    path.write_text(box_obj(boxes))
    return path
