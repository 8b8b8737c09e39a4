"""The facts of a source as lines of text."""

from collections.abc import Iterable, Iterator

from terrafix.messages import Fact


def fact_lines(name: str, facts: Iterable[Fact]) -> Iterator[str]:
    """One line for each fact, the topic in front; none without facts."""
    found = list(facts)
    if found:
        yield f"{name}:"
    width = max((len(fact.topic) for fact in found), default=0)
    for fact in found:
        yield f"  {fact.topic:<{width}}  {fact.text}"
