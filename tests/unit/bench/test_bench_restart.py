"""Figures of hot restarts, and of the thermal bands of a heat cycle."""

import math
from collections.abc import Sequence

import numpy as np
import pytest

from terrafix.core.config import HealthSection
from terrafix.messages import CovarianceMode, Health, NavEstimate, SourceLabel, ThermalBand
from terrafix_tools.bench.heat_cycle import BANDS, judged, temperature_mc
from terrafix_tools.bench.restart import Kill, missed, summary


@pytest.mark.parametrize(
    ("fix_s", "is_missed"),
    [
        ([0.0, 1.9, 3.9], False),
        ([2.1, 2.1, 3.9], True),
        ([0.0, 0.0, 4.1], True),
        ([0.0, 0.0, None], True),
    ],
)
def test_a_row_misses_the_limits_by_its_median_its_worst_or_a_fix_that_did_not_come(
    fix_s: Sequence[float | None], is_missed: bool
) -> None:
    row = summary([Kill("link", 0.2, 0.0, back) for back in fix_s])
    assert (missed({"link": row}) == ["link"]) is is_missed
    assert row["kills"] == 3 and row["silence_worst_s"] == 0.2
    assert (row["fix_worst_s"] is None) is (None in fix_s)


def test_silence_counts_as_the_fix_does() -> None:
    assert missed({"all": summary([Kill("all", 4.5, 0.0, 0.0)])}) == ["all"]
    assert missed({"all": summary([])}) == []


def health(second: int, band: ThermalBand, temperature_c: float | None) -> Health:
    return Health(
        t_ns=second * 10**9, band=band, temperature_c=temperature_c, throttled=False, disk_free_mb=None, cause=""
    )


def estimate(t_s: float, sigma_m: float) -> NavEstimate:
    """With ``sigma_m`` east, and half of it north."""
    cov = np.diag([sigma_m**2, sigma_m**2 / 4, 1.0, 1e-4, 1e-4, 1e-4])
    return NavEstimate(
        t_ns=round(1e9 * t_s),
        frame_id=0,
        lat_deg=0.0,
        lon_deg=0.0,
        alt_amsl_m=0.0,
        agl_m=0.0,
        velocity_enu_mps=(0.0, 0.0, 0.0),
        velocity_sigma_mps=1.0,
        q_w_b=(1.0, 0.0, 0.0, 0.0),
        cov=tuple(cov.ravel().tolist()),
        source_label=SourceLabel.SATELLITE_ANCHORED,
        covariance_mode=CovarianceMode.MARGINALS,
        last_anchor_age_ms=0,
        emitted_at_ns=0,
    )


def test_bands_are_compared_with_the_configuration_and_steps_are_those_at_the_switches() -> None:
    temperatures = [40.0, 80.5, 95.0, 90.0, 75.0]
    messages = [health(i, band, c) for i, (band, c) in enumerate(zip(BANDS, temperatures, strict=True))]
    estimates = [estimate(0.1 * i, 2.0 + (0.4 if 0.1 * i >= 2.0 else 0.0)) for i in range(50)]
    found = judged(messages, estimates, HealthSection())
    assert found["bands"] == ["normal", "hot", "critical", "hot", "normal"] and found["not_as_configured"] == 0
    assert found["steps_at_switches"] == pytest.approx([0.0, 0.2, 0.0, 0.0])
    wrong = [*messages, health(5, ThermalBand.NORMAL, 81.0), health(6, ThermalBand.NORMAL, None)]
    assert judged(wrong, estimates, HealthSection())["not_as_configured"] == 2


def test_a_switch_without_an_estimate_afterwards_has_no_step() -> None:
    messages = [health(0, ThermalBand.NORMAL, 40.0), health(9, ThermalBand.HOT, 81.0)]
    assert math.isnan(
        judged(messages, [estimate(0.0, 1.0), estimate(0.1, 1.0)], HealthSection())["steps_at_switches"][0]
    )


def test_the_zone_goes_up_and_down_again() -> None:
    degrees = [temperature_mc(share, np.random.default_rng(1)) / 1000 for share in (-1.0, 0.0, 0.5, 1.0, 2.0)]
    assert degrees == pytest.approx([40.0, 40.0, 96.0, 40.0, 40.0], abs=1.0)
