"""The schemas of CityJSON 2.0 as cityjson.org publishes them, out of the wheel of its own validator.

They are not ours to hand on, and the validator (MIT) has no wheel for every Python; any of its wheels holds
the schemas as text, and the environment variable says where one lies:

    pip download cjvalpy==0.4.1 --no-deps --only-binary :all: --python-version 3.10 --platform win_amd64
    LODBENCH_CJVALPY=cjvalpy-0.4.1-cp310-none-win_amd64.whl pytest tests/citymodel
"""

import json
import os
import zipfile
from functools import lru_cache
from typing import Any

import jsonschema
import pytest

_BEGIN = b'{"$schema"'
_IDS = {
    f"https://www.cityjson.org/schemas/2.0.0/{name}.schema.json": kind
    for name, kind in (("cityjson", "CityJSON"), ("cityjsonfeature", "CityJSONFeature"))
}


def assert_valid(document: dict[str, Any]) -> None:
    """Checks a CityJSON document, or a feature of a sequence; without a schema the test is left out."""
    wheel = os.environ.get("LODBENCH_CJVALPY")
    if not wheel:
        pytest.skip("LODBENCH_CJVALPY names no wheel of cjvalpy, which holds the published schemas")
    faults = sorted(_validators(wheel)[document["type"]].iter_errors(document), key=lambda fault: fault.path)
    assert not faults, "\n".join(f"{list(fault.path)}: {fault.message[:200]}" for fault in faults[:5])


@lru_cache(maxsize=1)
def _validators(wheel: str) -> dict[str, jsonschema.Draft7Validator]:
    with zipfile.ZipFile(wheel) as archive:
        module = next(name for name in archive.namelist() if name.endswith((".pyd", ".so")))
        content = archive.read(module)
    found = {}
    begin = content.find(_BEGIN)
    while begin >= 0:
        schema, _ = json.JSONDecoder().raw_decode(content[begin : begin + (1 << 20)].decode("latin-1"))
        if schema.get("$id") in _IDS:
            found[_IDS[schema["$id"]]] = jsonschema.Draft7Validator(schema)
        begin = content.find(_BEGIN, begin + 1)
    return found
