"""The tests of this folder run twice: on the slave core in Python and on that of the C firmware."""

import device_bench
import pytest
from c_device import skip_without_compiler


@pytest.fixture(params=list(device_bench.IMPLEMENTATIONS), autouse=True)
def implementation(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> str:
    """The language of the devices that `device_bench` makes."""
    if request.param == "c":
        skip_without_compiler()
    monkeypatch.setattr(device_bench, "chosen", request.param)
    return str(request.param)
