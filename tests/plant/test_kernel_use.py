"""A kernel for few effects is prepared once enough has been computed without it."""
from __future__ import annotations

import pytest

from plant.kernel_use import WORTH_COMPILING, WORTH_LOADING, KernelUse


@pytest.mark.parametrize(("is_stored", "worth"), [(True, WORTH_LOADING), (False, WORTH_COMPILING)])
def test_a_kernel_is_prepared_once_when_enough_has_been_computed_without_it(is_stored: bool, worth: float) -> None:
    use, prepared = KernelUse(), []

    def ask(kernel: str, steps: float) -> bool:
        return use.is_ready(kernel, steps, lambda: is_stored, lambda: prepared.append(kernel))

    assert not ask("lag", 0.6 * worth)
    assert not ask("ripple", 0.6 * worth)
    assert prepared == []
    assert ask("lag", 0.6 * worth)
    assert ask("lag", 1.0)
    assert prepared == ["lag"]
