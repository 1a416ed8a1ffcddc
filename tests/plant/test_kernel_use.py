"""A kernel for few effects is prepared once enough has been computed without it."""
from __future__ import annotations

import threading

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


def test_other_threads_do_without_a_kernel_while_one_prepares_it() -> None:
    use, begun, may_end = KernelUse(), threading.Event(), threading.Event()

    def prepare() -> None:
        begun.set()
        assert may_end.wait(30.0)

    found: list[bool] = []
    thread = threading.Thread(target=lambda: found.append(use.is_ready("lag", 1e12, bool, prepare)))
    thread.start()
    assert begun.wait(30.0)
    assert not use.is_ready("lag", 1e12, bool, prepare)
    assert not use.is_ready("ripple", 1e12, bool, prepare)
    may_end.set()
    thread.join(30.0)
    assert found == [True] and use.is_ready("lag", 1.0, bool, prepare)


def test_a_kernel_that_cannot_be_compiled_says_so_each_time() -> None:
    use = KernelUse()

    def fail() -> None:
        raise ValueError("law")

    for _ in range(2):
        with pytest.raises(ValueError, match="law"):
            use.is_ready("lag", 1e12, bool, fail)
