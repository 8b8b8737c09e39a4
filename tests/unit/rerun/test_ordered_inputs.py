"""Inputs of a process in the order that its InputOrder messages state."""

from flight_records import frame, origin
from terrafix.messages import Frame, InputOrder, Message, Origin
from terrafix.runtime.input_order import MAX_INPUTS, InputLog, key_of
from terrafix_tools.rerun.ordered_inputs import LATE_NS, OrderedInputs

PROCESS = "estimator"


def order(*messages: Message, process: str = PROCESS, began_ns: int = 1) -> InputOrder:
    return InputOrder(t_ns=0, process=process, began_ns=began_ns, inputs=[key_of(message) for message in messages])


def ids(taken: list[tuple[int, Message]]) -> list[int]:
    return [message.frame_id for _, message in taken if isinstance(message, Frame)]


def test_inputs_come_in_the_stated_order_and_not_in_that_of_reception() -> None:
    inputs = OrderedInputs(PROCESS)
    for number in (0, 1, 2):
        inputs.put(frame(number), number)
    inputs.order(order(frame(2), frame(0)), 3)
    assert ids(list(inputs.take(3))) == [2, 0]
    assert (inputs.undelivered, inputs.missing) == (1, 0), "frame 1 was not handled"


def test_an_input_that_is_recorded_after_its_order_is_waited_for() -> None:
    inputs = OrderedInputs(PROCESS)
    inputs.put(frame(1), 0)
    inputs.order(order(frame(0), frame(1)), 0)
    assert ids(list(inputs.take(LATE_NS - 1))) == []
    inputs.put(frame(0), LATE_NS - 1)
    assert ids(list(inputs.take(LATE_NS - 1))) == [0, 1]
    assert inputs.missing == 0


def test_an_input_that_the_record_lacks_is_counted_after_the_longest_delay_and_the_rest_follows() -> None:
    inputs = OrderedInputs(PROCESS)
    inputs.put(frame(1), 0)
    inputs.order(order(frame(0), frame(1)), 0)
    assert ids(list(inputs.take(LATE_NS))) == [1]
    assert inputs.missing == 1


def test_at_the_end_of_the_record_nothing_is_waited_for() -> None:
    inputs = OrderedInputs(PROCESS)
    inputs.put(frame(1), 0)
    inputs.order(order(frame(0), frame(1)), 0)
    assert ids(list(inputs.finish())) == [1]
    assert list(inputs.finish()) == []


def test_the_order_of_another_process_is_ignored() -> None:
    inputs = OrderedInputs(PROCESS)
    inputs.put(frame(0), 0)
    inputs.order(order(frame(0), process="anchor"), 0)
    assert list(inputs.finish()) == []


def test_equal_messages_are_delivered_as_often_as_they_were_handled() -> None:
    inputs = OrderedInputs(PROCESS)
    inputs.put(frame(0), 0)
    inputs.put(frame(0), 1)
    inputs.order(order(frame(0), frame(0)), 1)
    assert ids(list(inputs.take(1))) == [0, 0]
    assert inputs.missing == 0


def test_a_retained_message_is_delivered_to_every_instance_of_the_process() -> None:
    inputs = OrderedInputs(PROCESS)
    inputs.put(origin(), 0)
    inputs.put(origin(), 1)  # the record repeats it in its next segment
    inputs.order(order(origin(), began_ns=1), 2)
    inputs.order(order(origin(), began_ns=2), 3)
    delivered = list(inputs.take(3))
    assert [began_ns for began_ns, _ in delivered] == [1, 2]
    assert all(isinstance(message, Origin) for _, message in delivered)
    assert inputs.undelivered == 0


def test_inputs_that_no_order_names_are_dropped_after_a_while() -> None:
    inputs = OrderedInputs(PROCESS)
    inputs.put(frame(0), 0)
    inputs.put(frame(1), LATE_NS)
    list(inputs.take(2 * LATE_NS + 1))
    inputs.order(order(frame(0), frame(1)), 2 * LATE_NS + 1)
    assert ids(list(inputs.finish())) == [1], "only the newer one is still there"
    assert (inputs.undelivered, inputs.missing) == (1, 1)


def test_an_input_log_gives_each_input_once_and_nothing_without_inputs() -> None:
    log = InputLog(PROCESS, began_ns=5)
    assert log.take(0) is None
    log.add(frame(0))
    log.add(frame(1))
    assert log.take(7) == InputOrder(t_ns=7, process=PROCESS, began_ns=5, inputs=[key_of(frame(0)), key_of(frame(1))])
    assert log.take(8) is None


def test_an_input_log_states_when_it_has_to_be_published_without_an_output() -> None:
    log = InputLog(PROCESS, began_ns=5)
    for number in range(MAX_INPUTS):
        assert not log.full
        log.add(frame(number))
    assert log.full
