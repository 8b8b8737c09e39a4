"""Frame rate of a live source by thermal band: in a hot computer fewer frames are taken from it."""

from terrafix.core.clock import NS_PER_S
from terrafix.core.config import HealthSection
from terrafix.messages import ThermalBand


class FrameRateLimit:
    """Selects the frames that are taken from a source. ``band``: of the newest Health message."""

    def __init__(self, health: HealthSection) -> None:
        self._period_ns = {
            ThermalBand.NORMAL: 0,
            ThermalBand.HOT: round(NS_PER_S / health.hot_rate_hz),
            ThermalBand.CRITICAL: round(NS_PER_S / health.critical_rate_hz),
        }
        self._due_ns = 0
        self.band = ThermalBand.NORMAL

    def takes_frame(self, t_ns: int) -> bool:
        """Whether the frame at ``t_ns`` is taken. Call it once for every frame, in order of time."""
        period_ns = self._period_ns[self.band]
        if t_ns < self._due_ns and period_ns:
            return False
        # On a grid, so that the mean rate holds for a camera whose rate is no multiple of it; a gap begins a new grid.
        on_grid = t_ns - self._due_ns < period_ns
        self._due_ns = (self._due_ns if on_grid else t_ns) + period_ns
        return True
