"""The learned model in flight: what runs it, what it could not answer, and when matching goes on without it."""

from terrafix.anchor.matching.descriptor_cache import Describer
from terrafix.messages import ModelChange, ModelEvent
from terrafix_engines.features.xfeat import XFeatDescriber
from terrafix_engines.providers import short

FAILURES = 5  # frames in a row without an answer: the model is given up for this flight


class ModelWatch:
    """Nothing to say of a describer without weights, unless another was wanted: ``not_opened`` says why it is not."""

    def __init__(self, describer: Describer, not_opened: str = "") -> None:
        self._name = describer.name
        self._not_opened = not_opened
        self._model = describer.model if isinstance(describer, XFeatDescriber) else None
        self._said = 0  # of the providers that were passed over
        self._failures = 0
        self._answers = 0  # of the model, when it was last looked at

    def opened(self, t_ns: int) -> list[ModelEvent]:
        """At the start of a flight."""
        if self._not_opened:
            return [self._event(t_ns, ModelChange.GIVEN_UP, self._not_opened)]
        if self._model is None:
            return []
        self._said = len(self._model.passed_over)
        why = "".join(f"; {over}" for over in self._model.passed_over)
        return [self._event(t_ns, ModelChange.OPENED, f"sha256 {self._model.sha256[:12]}{why}")]

    def answered(self, t_ns: int) -> list[ModelEvent]:
        """After a frame that did not need it, or that it described: only these end a row of failures."""
        if self._model is not None and self._model.answers != self._answers:
            self._failures, self._answers = 0, self._model.answers
        return self._moved(t_ns)

    def failed(self, t_ns: int, reason: str) -> list[ModelEvent]:
        """After a frame that it did not; ``given_up`` is true from the last one on."""
        self._failures += 1
        self._answers = self._model.answers if self._model is not None else 0
        said = [*self._moved(t_ns), self._event(t_ns, ModelChange.FAILED, reason)]
        if self.given_up:
            said.append(self._event(t_ns, ModelChange.GIVEN_UP, f"{self._failures} frames in a row without an answer"))
        return said

    @property
    def given_up(self) -> bool:
        return self._failures >= FAILURES

    def _moved(self, t_ns: int) -> list[ModelEvent]:
        if self._model is None or len(self._model.passed_over) == self._said:
            return []
        new, self._said = self._model.passed_over[self._said :], len(self._model.passed_over)
        return [self._event(t_ns, ModelChange.PROVIDER, "; ".join(str(over) for over in new))]

    def _event(self, t_ns: int, change: ModelChange, detail: str) -> ModelEvent:
        provider = short(self._model.provider) if self._model is not None else ""
        return ModelEvent(t_ns=t_ns, model=self._name, change=change, provider=provider, detail=detail)
