"""Monitor of the learned model in flight: its execution provider, its failures, and the decision to continue without
it."""

from terrafix.anchor.matching.descriptor_cache import Describer
from terrafix.messages import ModelChange, ModelEvent
from terrafix_engines.features.xfeat import XFeatDescriber
from terrafix_engines.providers import short_name

MAX_MODEL_FAILURES = 5  # consecutive frames without a result after which the model is disabled for this flight [tuned]


class ModelMonitor:
    """Emits nothing for a describer without weights, unless a model was configured and could not be opened;
    ``not_opened`` is then the reason."""

    def __init__(self, describer: Describer, not_opened: str = "") -> None:
        self.name = describer.name
        self._not_opened = not_opened
        self._model = describer.model if isinstance(describer, XFeatDescriber) else None
        self._reported = 0  # number of rejected execution providers that were already reported
        self._failures = 0
        self._results = 0  # number of model results at the last check

    def opened(self, t_ns: int) -> list[ModelEvent]:
        """Events at the start of a flight."""
        if self._not_opened:
            return [self.event(t_ns, ModelChange.GIVEN_UP, self._not_opened)]
        if self._model is None:
            return []
        self._reported = len(self._model.rejected_providers)
        why = "".join(f"; {rejected}" for rejected in self._model.rejected_providers)
        return [self.event(t_ns, ModelChange.OPENED, f"sha256 {self._model.sha256[:12]}{why}")]

    def succeeded(self, t_ns: int) -> list[ModelEvent]:
        """After a frame without a failure. Only a frame for which the model produced a result resets the failure
        count."""
        if self._model is not None and self.has_run:
            self._failures, self._results = 0, self._model.run_count
        return self._provider_events(t_ns)

    def failed(self, t_ns: int, reason: str) -> list[ModelEvent]:
        """After a frame on which the model failed; ``given_up`` is true from the ``MAX_MODEL_FAILURES``-th consecutive
        one on."""
        self._failures += 1
        self._results = self._model.run_count if self._model is not None else 0
        events = [*self._provider_events(t_ns), self.event(t_ns, ModelChange.FAILED, reason)]
        if self.given_up:
            events.append(self.event(t_ns, ModelChange.GIVEN_UP, f"{self._failures} frames in a row without an answer"))
        return events

    @property
    def is_learned(self) -> bool:
        """Whether the describer has weights."""
        return self._model is not None

    @property
    def has_run(self) -> bool:
        """Whether the model has produced a result since the last frame."""
        return self._model is not None and self._model.run_count != self._results

    @property
    def given_up(self) -> bool:
        return self._failures >= MAX_MODEL_FAILURES

    def _provider_events(self, t_ns: int) -> list[ModelEvent]:
        if self._model is None or len(self._model.rejected_providers) == self._reported:
            return []
        new, self._reported = self._model.rejected_providers[self._reported :], len(self._model.rejected_providers)
        return [self.event(t_ns, ModelChange.PROVIDER, "; ".join(str(rejected) for rejected in new))]

    def event(self, t_ns: int, change: ModelChange, detail: str) -> ModelEvent:
        provider = short_name(self._model.provider) if self._model is not None else ""
        return ModelEvent(t_ns=t_ns, model=self.name, change=change, provider=provider, detail=detail)
