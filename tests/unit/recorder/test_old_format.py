"""Records from before types and fields were renamed: JSON as those versions wrote it."""

from terrafix.messages import CalibrationEstimate, EkfDeadReckoning, EkfStatus
from terrafix.recorder.old_format import OLD_TOPICS
from terrafix.recorder.schema import TYPE_BY_TOPIC

COASTED = (
    b'{"type":"Coasted","t_ns":5,"coast_s":2.5,"lat_deg":48.0,"lon_deg":11.0,"velocity_enu_mps":[1.0,2.0,3.0],'
    b'"position_sigma_m":4.0,"velocity_sigma_mps":0.5,"way_m":[6.0,7.0],"gain_mps":[0.1,0.2,0.3]}'
)
SLOW_ERRORS = (
    b'{"type":"SlowErrors","t_ns":7,"frame_id":3,"error":[0.1,0.2,0.3,4.0,0.05,0.06],"cov":[1.0],'
    b'"lens":{"value":[0.1],"information":[2.0]}}'
)


def test_dead_reckoning_of_an_old_record_has_the_names_of_preintegration() -> None:
    message = OLD_TOPICS["/coasted"].decode(COASTED)
    assert isinstance(message, EkfDeadReckoning)
    assert (message.t_ns, message.duration_s, message.delta_p_m) == (5, 2.5, (6.0, 7.0))
    assert message.delta_v_mps == (0.1, 0.2, 0.3) and message.velocity_enu_mps == (1.0, 2.0, 3.0)
    assert (message.lat_deg, message.lon_deg) == (48.0, 11.0)
    assert (message.position_sigma_m, message.velocity_sigma_mps) == (4.0, 0.5)


def test_calibration_of_an_old_record_keeps_its_numbers() -> None:
    message = OLD_TOPICS["/slow_errors"].decode(SLOW_ERRORS)
    assert isinstance(message, CalibrationEstimate)
    assert (message.t_ns, message.frame_id) == (7, 3)
    assert message.state == (0.1, 0.2, 0.3, 4.0, 0.05, 0.06) and message.cov == (1.0,)
    assert message.lens is not None and (message.lens.value, message.lens.information) == ((0.1,), (2.0,))


def test_no_old_topic_is_one_of_today() -> None:
    assert not set(OLD_TOPICS) & set(TYPE_BY_TOPIC)
    assert OLD_TOPICS["/filter_status"].type is EkfStatus
