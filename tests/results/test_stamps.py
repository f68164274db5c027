"""A stamp leaves the text of a page as it is, and is read back."""

import pytest

from tests.results.stamps import NOT_KNOWN, Stamp, is_marked, marked, stale_rooms, without_stamp

STAMP = Stamp("b6929adc", "2026-11-28", "python -m x results", NOT_KNOWN, "17 of 300 sets", {"fem": "12345678"})
PAGE = "# A title\n\n*Made on* paper.\n\n| a |\n| -- |\n| 1 |\n"


def test_a_stamp_is_read_back_and_replaced():
    page = STAMP.put_on(PAGE)
    assert Stamp.of(page) == STAMP
    assert page.startswith(PAGE)
    assert "*Made on 2026-11-28 of commit b6929adc by `python -m x results`. 17 of 300 sets." in page
    other = Stamp("0" * 8, "2027-01-01", "y", "Machine: z", "", {})
    assert other.put_on(page) == other.put_on(PAGE)
    assert without_stamp(marked(page, True)) == PAGE
    assert Stamp.of(PAGE) is None


@pytest.mark.parametrize("page", [PAGE, STAMP.put_on(PAGE)], ids=["without a stamp", "with one"])
def test_the_first_line_says_that_a_page_is_stale_once(page):
    once = marked(page, True)
    assert is_marked(once)
    assert not is_marked(page)
    assert once.startswith("> **Stale**: ")
    assert marked(once, True) == once
    assert marked(once, False) == page
    assert Stamp.of(once) == Stamp.of(page)


def test_a_page_is_stale_if_a_room_has_changed_or_it_has_no_stamp():
    page = marked(STAMP.put_on(PAGE), True)
    assert stale_rooms(page, {"fem": "12345678"}) == []
    assert stale_rooms(page, {"fem": "12345679"}) == ["fem"]
    assert stale_rooms(page, {"fem": "12345678", "types": "1"}) == ["types"]
    assert stale_rooms(PAGE, {"fem": "12345678"}) == ["fem"]
