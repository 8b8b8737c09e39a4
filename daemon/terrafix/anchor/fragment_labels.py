"""Steps of the search escalation by the fragments of odometry: a new one, and its merge (PB-8)."""

from dataclasses import dataclass

from terrafix.messages import MapMatch, Prediction, SearchStep, Verdict


@dataclass
class FragmentLabels:
    """``step_of`` every frame, in order. The first fragment of a flight is no step."""

    _newest_id: int | None = None  # of the fragments so far
    _open: bool = False  # nothing has joined the newest fragment yet

    def step_of(self, match: MapMatch, prediction: Prediction) -> SearchStep | None:
        """NEW_FRAGMENT for the first frame of a fragment that is not skipped, MERGE once when the fragment is joined to
        the flight or a search has found the place, SKIP for a frame that neither odometry nor the map registers; else
        None: ``match`` keeps its step."""
        if match.search.step is SearchStep.SKIP:
            return None
        if self._begins(prediction.fragment_id):
            self._open = True
            return SearchStep.NEW_FRAGMENT
        pose = match.verdict is Verdict.ACCEPTED and not match.position_only
        joined = prediction.fragment_id >= 0 and prediction.joined
        if match.search.relocalized or (self._open and (pose or joined)):
            self._open = False
            return SearchStep.MERGE
        tracking = match.search.step is SearchStep.NORMAL and match.verdict is not Verdict.ACCEPTED
        return SearchStep.SKIP if tracking and prediction.fragment_id < 0 else None

    def _begins(self, fragment_id: int) -> bool:
        """Whether a fragment begins that is newer than all before."""
        first, before = self._newest_id is None, -1 if self._newest_id is None else self._newest_id
        if fragment_id <= before:
            return False
        self._newest_id = fragment_id
        return not first
