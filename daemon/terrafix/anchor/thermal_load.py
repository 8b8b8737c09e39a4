"""Load of map matching by thermal band: every frame, or one of several, with the learned model or without it."""

from terrafix.core.config import HealthSection
from terrafix.messages import ThermalBand


class ThermalLoad:
    """``band``: of the newest Health message."""

    def __init__(self, health: HealthSection) -> None:
        self._every = {
            ThermalBand.NORMAL: 1,
            ThermalBand.HOT: health.hot_match_every,
            ThermalBand.CRITICAL: health.critical_match_every,
        }
        self._skipped = 0  # frames since the last one that was matched
        self.band = ThermalBand.NORMAL

    @property
    def allows_model(self) -> bool:
        """Whether the learned model may run."""
        return self.band is not ThermalBand.CRITICAL

    def takes_frame(self) -> bool:
        """Whether the next frame is matched with the map. Call it once for every frame."""
        self._skipped += 1
        if self._skipped < self._every[self.band]:
            return False
        self._skipped = 0
        return True
