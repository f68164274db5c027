"""Pages of results/ say in their first lines if they are stale, and a study answers for every file."""

from dataclasses import replace

import pytest

from tests.results import status
from tests.results.stamps import Stamp
from tests.results.status import RESULTS, ROOT, mark, pages
from tests.results.studies import CORES, MOST_MINUTES, STUDIES, TOTAL_MINUTES, chosen, wall_minutes


def test_stale_pages_say_so_in_their_first_line():
    false = [str(page.path.relative_to(ROOT)) for page in pages() if not page.is_true]
    assert false == [], "run `make results-status`, and commit the first lines that it writes"


def test_a_study_answers_for_every_file():
    names = [name for study in STUDIES for name in (*study.pages, *study.folders)]
    owned = tuple(RESULTS / name for name in names)
    strays = [path for path in RESULTS.rglob("*.*") if not any(path.is_relative_to(one) for one in owned)]
    assert [path for path in strays if path.is_file()] == []


def test_budgets_fit():
    assert wall_minutes() <= TOTAL_MINUTES
    assert max(study.minutes for study in STUDIES) <= MOST_MINUTES
    first = [study.exclusive for study in STUDIES]
    assert first == sorted(first, reverse=True)
    assert CORES == 2


def test_all_studies_take_the_same_arguments():
    for study in STUDIES:
        if study.arguments[:2] == ("{out}", "--kept"):
            base = ROOT.joinpath(*study.module.split("."))
            file = next(one for one in (base.with_suffix(".py"), base / "__main__.py") if one.is_file())
            assert "study_parser(__doc__)" in file.read_text(encoding="utf-8"), study.name


def test_names_and_groups_choose_studies():
    assert chosen(()) == list(STUDIES)
    assert [study.name for study in chosen(("mutants", "kills"))] == ["mutants", "kills"]
    assert {study.group for study in chosen(("bench",))} == {"bench"}
    with pytest.raises(ValueError, match="no study or group 'none': use one of bench"):
        chosen(("none",))


def test_marking_corrects_first_lines_alone(tmp_path, monkeypatch):
    monkeypatch.setattr(status, "STUDIES", [study for study in STUDIES if "frfs.md" in study.pages])
    path = tmp_path / "frfs.md"
    stamp = Stamp("b6929adc", "2026-11-28", "c", "m", "", {"fem": "12345678"})
    path.write_text(stamp.put_on("# FRFs\n"), encoding="utf-8")
    (page,) = mark(pages(tmp_path))
    assert page.path == path
    assert path.read_text(encoding="utf-8").startswith(
        "> **Stale**: this page was made on 2026-11-28 of commit b6"
    )
    fresh = replace(stamp, rooms=page.now).put_on(path.read_text(encoding="utf-8"))
    path.write_text(fresh, encoding="utf-8")
    assert mark(pages(tmp_path)) == []
    assert path.read_text(encoding="utf-8") == fresh
