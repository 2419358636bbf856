"""Results shared between test processes: computed once, keyed by the arguments."""

import threading
from pathlib import Path

import pytest

from armident.configs import load_robot
from tests.fixtures import store
from tests.fixtures.arms import hide

calls: list[tuple[object, ...]] = []


def slow_square(x: float, *rest: object) -> float:
    calls.append((x, *rest))
    return x * x


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setattr(store, "_folder", tmp_path)
    calls.clear()
    return tmp_path


def test_a_second_process_loads_what_the_first_computed() -> None:
    # Each wrapper has a memory of its own, as each process has.
    first, second = store.shared(slow_square), store.shared(slow_square)
    assert first(3.0) == second(3.0) == 9.0
    assert calls == [(3.0,)]


def test_wrappers_that_ask_at_once_compute_once() -> None:
    results: list[float] = []
    threads = [threading.Thread(target=lambda: results.append(store.shared(slow_square)(2.0))) for _ in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert results == [4.0] * 8
    assert calls == [(2.0,)]


def test_other_arguments_are_another_result() -> None:
    square = store.shared(slow_square)
    soft, stiff = hide("joint_spring", "joint_1", stiffness=1.0), hide("joint_spring", "joint_1", stiffness=2.0)
    for rest in ((), (1,), ("1",), (soft,), (stiff,), (load_robot("emps"),), ((soft, stiff),), (soft, stiff)):
        square(1.0, *rest)
    assert len(calls) == 8


def test_a_default_and_the_same_value_given_are_one_result() -> None:
    def power(x: float, exponent: float = 2.0) -> float:
        return slow_square(x, exponent)

    share = store.shared(power)
    assert share(3.0) == share(3.0, 2.0) == share(x=3.0, exponent=2.0) == 9.0
    assert calls == [(3.0, 2.0)]


def test_an_argument_without_a_text_of_its_own_is_refused() -> None:
    with pytest.raises(TypeError, match="list is no key"):
        store.shared(slow_square)(1.0, [1])


def test_without_a_folder_results_stay_in_the_process(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(store, "_folder", None)
    square = store.shared(slow_square)
    assert square(5.0) == square(5.0) == 25.0
    assert calls == [(5.0,)]


def test_a_kept_result_outlives_its_run_until_a_source_changes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    source = tmp_path / "source.py"
    monkeypatch.setattr(store, "REPOSITORY", tmp_path)
    monkeypatch.setattr(store, "SOURCES", ("source.py",))
    monkeypatch.setattr(store, "KEPT", tmp_path / "kept")
    monkeypatch.setattr(store, "kept_folder", store.kept_folder.__wrapped__)
    for text, computed in (("a", 1), ("a", 1), ("b", 2), ("a", 2), ("c", 3), ("b", 4)):
        source.write_text(text)
        # Another wrapper, as in another run.
        assert store.kept(slow_square)(3.0) == 9.0
        assert len(calls) == computed
    assert len(list((tmp_path / "kept").iterdir())) == 2
