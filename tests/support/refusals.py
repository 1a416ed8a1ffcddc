"""What the code says about input that it must refuse."""

from collections.abc import Callable

import pytest

from plant import InputError


def catch_refusal(call: Callable[..., object], *arguments: object, **options: object) -> str:
    """The text of the InputError that a call raises: one line."""
    with pytest.raises(InputError) as caught:
        call(*arguments, **options)
    assert "\n" not in str(caught.value)
    return str(caught.value)
