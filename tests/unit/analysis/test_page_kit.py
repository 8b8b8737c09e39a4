"""The kit of the offline pages: what is text, what is HTML."""

import pytest
from jinja2 import UndefinedError
from markupsafe import Markup

from terrafix_tools.pages.document import Figure, kit, macros

BAD = '<b onclick="x()">&'
ESCAPED = "&lt;b onclick=&#34;x()&#34;&gt;&amp;"


@pytest.mark.parametrize(
    "html",
    [
        kit.document(BAD, "", kit.header(BAD, BAD, BAD)),
        kit.section(BAD, BAD, BAD),
        kit.block(BAD, BAD),
        kit.figures([Figure(BAD, BAD, BAD, BAD)]),
        kit.table([BAD], [[BAD]], css=BAD),
        kit.facts([(BAD, BAD)]),
        kit.timeline([(BAD, BAD)]),
        kit.counts([(BAD, 1, BAD)], BAD),
        kit.legend([(BAD, BAD)]),
        kit.two(BAD, BAD),
        kit.folded(BAD, BAD),
        kit.pre(BAD),
    ],
)
def test_text_is_escaped_wherever_it_is_put(html: str) -> None:
    assert ESCAPED in html and BAD not in html


def test_html_of_the_kit_stays_html_in_the_kit() -> None:
    inner = kit.facts([("name", None)])
    assert inner == Markup("<table><tr><td>name</td><td>-</td></tr></table>\n")
    assert str(inner) in kit.section("title", "", kit.scroll(kit.two("", inner)))


def test_data_of_the_script_cannot_end_the_script() -> None:
    html = macros("terrafix_tools/report.html").pointed([{"i": 0, "t": 0.0, "h": "</script><script>x()"}])
    assert html.count("<script") == 2 and html.count("</script>") == 2


def test_a_name_that_a_template_does_not_know_is_an_error() -> None:
    with pytest.raises(UndefinedError):
        kit.figures([object()])
