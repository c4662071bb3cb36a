"""What benches say, and how it is compared with what is stored."""

from __future__ import annotations

from math import nan

import pytest
from msgspec.structs import replace

from bench import page, suite
from bench.entries import ENTRIES
from bench.report import (
    Chart,
    Figure,
    Machine,
    Report,
    Result,
    Series,
    Table,
    decode,
    encode,
    number,
    percentile,
    turns,
    worse,
)

MACHINE = Machine("a processor", 2, 24.0, "Linux 6", "3.12", 0.0)


def result(*figures: Figure, form: str = "full") -> Result:
    chart = Chart("line", "a line", "x, s", "y, s", [Series("ours", [(1.0, 2.0, 1.5, 2.5), (2.0, 3.0, 2.5, 3.5)])])
    return Result("try", "Tries.", "python -m bench try", form, "2000-01-01", "", 1.0, MACHINE, list(figures), [chart])  # type: ignore[arg-type]


def test_a_figure_has_its_median_and_the_middle_of_its_samples() -> None:
    figure = Report().value("time", [float(n) for n in range(11)], "ms", at_most=5.0)
    assert (figure.median, figure.low, figure.high, figure.count) == (5.0, 1.0, 9.0, 11)
    assert figure.kept
    assert not Report().value("time", [1.0], "ms", at_most=0.5).kept
    assert not Report().value("time", [1.0], "ms", at_least=1.5).kept


def test_a_ratio_is_of_samples_that_belong_together() -> None:
    figure = Report().ratio("plain / ours", [10.0, 30.0, 20.0], [1.0, 3.0, 4.0], at_least=10.0)
    assert (figure.median, figure.unit, figure.better) == (10.0, "x", "more")
    for over, under in (([1.0], [1.0, 2.0]), ([1.0], [0.0]), ([], [])):
        with pytest.raises(ValueError, match="samples"):
            Report().ratio("a / b", over, under, at_most=1.0)
    with pytest.raises(ValueError, match="less or more"):
        Report().ratio("a / b", [1.0], [1.0])


def test_a_figure_without_finite_samples_or_with_a_name_that_is_taken_is_refused() -> None:
    report = Report()
    report.value("time", [1.0], "ms")
    with pytest.raises(ValueError, match="there is such a figure"):
        report.value("time", [1.0], "ms")
    for samples in ([], [nan]):
        with pytest.raises(ValueError, match="finite"):
            report.value("other", samples, "ms")


def test_a_share_of_trials_is_bounded_by_their_number() -> None:
    assert Report().share("held", 98, 100, at_least=98).kept
    assert not Report().share("held", 97, 100, at_least=98).kept


def test_things_take_turns_and_each_begins_a_round() -> None:
    order: list[str] = []

    def mark(name: str, value: int) -> int:
        order.append(name)
        return value

    first, second = turns(3, warm=1, a=lambda: mark("a", 1), b=lambda: mark("b", 2))
    assert order == ["a", "b", "b", "a", "a", "b", "b", "a"]
    assert (first, second) == ([1, 1, 1], [2, 2, 2])


def test_a_percentile_lies_between_samples() -> None:
    assert percentile([4.0, 1.0, 3.0, 2.0], 50) == 2.5
    assert percentile([7.0], 99) == 7.0


@pytest.mark.parametrize(
    ("value", "text"),
    [(0.0, "0"), (1234.6, "1,235"), (12.34, "12.3"), (1.239, "1.24"), (0.01234, "0.012"), (20.0, "20")],
)
def test_numbers_have_three_digits(value: float, text: str) -> None:
    assert number(value) == text


def test_results_survive_their_file_and_others_are_refused() -> None:
    made = result(Figure("a / b", "x", 1.0, 1.0, 1.0, 3, better="less"))
    assert decode(encode(made).encode(), "a file") == made
    with pytest.raises(ValueError, match=r"a file is no result"):
        decode(b"{}", "a file")


def test_a_ratio_falls_by_more_than_a_third_in_the_direction_that_is_worse() -> None:
    less, more = Figure("a", "x", 1.0, 1, 1, 1, better="less"), Figure("b", "x", 9.0, 9, 9, 1, better="more")
    assert not worse(Figure("a", "x", 1.5, 1, 1, 1, better="less"), less)
    assert worse(Figure("a", "x", 1.51, 1, 1, 1, better="less"), less)
    assert not worse(Figure("b", "x", 6.1, 6, 6, 1, better="more"), more)
    assert worse(Figure("b", "x", 5.9, 6, 6, 1, better="more"), more)
    now = result(Figure("b", "x", 5.9, 6, 6, 1, better="more"), Figure("ms", "ms", 99.0, 99, 99, 1))
    assert suite.fallen(now, result(more)) == ["try: b: 5.9, stored 9"]
    (told,) = suite.fallen(now, result())
    assert "no stored ratio" in told


def test_the_page_states_command_machine_figures_and_what_was_missed() -> None:
    made = result(Figure("a / b", "x", 2.0, 1.9, 2.1, 3, at_most=1.5, better="less"))
    text = page.section(made)
    assert "`python -m bench try`" in text
    assert "2 cores of a processor" in text
    assert "| a / b | 2 | 1.9 to 2.1 | 3 | at most 1.5: **missed** |" in text
    assert "![a line](benchmarks-try-line.png)" in text


def test_a_long_table_is_folded() -> None:
    short, long = (Table("a table", ["n"], [[str(n)] for n in range(count)]) for count in (3, page.LONG + 1))
    folded = ["<details>" in page.section(replace(result(), tables=[table])) for table in (short, long)]
    assert folded == [False, True]


def test_the_page_is_that_of_the_stored_results() -> None:
    stored = suite.read(suite.STORED)
    assert set(stored) <= set(ENTRIES)
    text = page.PAGE.read_text()
    for name, made in stored.items():
        assert made.form == "full"
        assert page.section(made) in text
        for chart in made.charts:
            assert (page.PAGE.parent / page.picture(name, chart)).is_file()


@pytest.mark.parametrize("name", ENTRIES)
def test_each_entry_says_what_it_measures(name: str) -> None:
    entry = ENTRIES[name]
    assert entry.about.endswith((".", "`"))
    assert callable(entry.load().measure)
