"""Checks the autopilot's parameters against the rules: a line per relevant parameter, and the proposed changes."""

from collections.abc import Iterable, Iterator, Sequence

from terrafix.link.output.selection import LOCAL_FRAME_OUTPUTS
from terrafix_tools.preflight import forwarding
from terrafix_tools.preflight.forwarding import SERIALS, mavlink_ports
from terrafix_tools.preflight.lines import CheckStatus, Line, ParameterChange, number, ok
from terrafix_tools.preflight.rules import ALWAYS, EXTERNAL_NAV, GPS_INPUT_RULES, LOCAL_RULES, Context, Rule, Values

SOURCE_SETS = (1, 2, 3)


def parameter_names(context: Context) -> list[str]:
    """Returns every parameter that a rule may need."""
    rules = [_name(rule, context) for rule in (*ALWAYS, *GPS_INPUT_RULES, *LOCAL_RULES)]
    sources = [f"EK3_SRC{k}_{what}" for k in SOURCE_SETS for what in ("POSXY", "VELXY", "YAW")]
    serial = [f"SERIAL{i}_{what}" for i in SERIALS for what in ("PROTOCOL", "BAUD")]
    names = [*rules, f"GPS{context.other}_TYPE", *sources, *serial, *forwarding.parameter_names(context)]
    return list(dict.fromkeys(names))


def check_parameters(values: Values, context: Context) -> Iterator[Line]:
    """Yields a line for each parameter that matters to the configured outputs."""
    outputs = context.outputs
    rules: list[Rule] = [*(GPS_INPUT_RULES if "gps_input" in outputs else ())]
    local = [name for name in outputs if name in LOCAL_FRAME_OUTPUTS]
    rules += LOCAL_RULES if local else ()
    skipped = set() if "gps_input" in outputs else {"EK3_SRC1_YAW"}  # checked for the source set in use, below
    rules += [rule for rule in ALWAYS if rule.name not in skipped]
    for rule in rules:
        if rule.applies(context, values):
            yield _line(rule, values, context)
    if local:
        yield _source_set(values, local)
    if context.link.device.startswith("/"):
        yield _serial(values, context.link.baud)
    if "gps_input" in outputs:
        yield forwarding.forwarding(values, context)
    yield _identity(context)


def proposed_changes(lines: Iterable[Line]) -> list[ParameterChange]:
    """-> one change for each parameter: the first that is proposed."""
    changes: dict[str, ParameterChange] = {}
    for line in lines:
        if line.change is not None:
            changes.setdefault(line.change.name, line.change)
    return list(changes.values())


def _name(rule: Rule, context: Context) -> str:
    return rule.name.format(n=context.gps, m=context.other)


def _line(rule: Rule, values: Values, context: Context) -> Line:
    name = _name(rule, context)
    value = values.get(name)
    if value is None:
        return Line(
            check=name,
            status=rule.status,
            text="this firmware has no such parameter",
            fix="the names are those of ArduPilot 4.6; check its documentation",
        )
    if rule.valid(value):
        return ok(name, number(value))
    new = rule.fix(value, context)
    return Line(
        check=name,
        status=rule.status,
        text=f"is {number(value)}: {rule.reason}",
        fix="" if new is None else f"set {number(new)}",
        change=None if new is None else ParameterChange(name=name, old=value, new=new),
    )


def _source_set(values: Values, outputs: Sequence[str]) -> Line:
    """One source set must use external navigation, without its yaw."""
    found = [k for k in SOURCE_SETS if values.get(f"EK3_SRC{k}_POSXY") == EXTERNAL_NAV]
    if not found:
        text = f"no EK3_SRCn_POSXY is 6, so that {', '.join(outputs)} is not used"
        return Line(check="source set", status=CheckStatus.FAIL, text=text, fix="set EK3_SRC2_POSXY 6 (and VELXY 6)")
    for k in found:
        if values.get(f"EK3_SRC{k}_YAW") == EXTERNAL_NAV:
            text = f"EK3_SRC{k}_YAW is 6: the attitude that we send is the autopilot's own"
            return Line(check="source set", status=CheckStatus.FAIL, text=text, fix=f"set EK3_SRC{k}_YAW 1")
        velocity = values.get(f"EK3_SRC{k}_VELXY") == EXTERNAL_NAV
        if velocity and "odometry" not in outputs:
            text = f"EK3_SRC{k}_VELXY is 6, and VISION_POSITION_ESTIMATE has no velocity"
            return Line(
                check="source set", status=CheckStatus.FAIL, text=text, fix=f"set EK3_SRC{k}_VELXY 0, or use odometry"
            )
    return ok("source set", f"{', '.join(map(str, found))} is external navigation")


def _serial(values: Values, baud: int) -> Line:
    """SERIALn_BAUD is in thousands for the usual speeds: 57 is 57600, 921 is 921600 (ArduPilot, AP_SerialManager)."""
    ports = {i: values.get(f"SERIAL{i}_BAUD") for i in mavlink_ports(values)}
    same = [i for i, code in ports.items() if code is not None and code in (baud, baud // 1000)]
    if same:
        return ok("serial port", f"SERIAL{same[0]} speaks MAVLink at {baud} baud")
    port_bauds = ", ".join(f"SERIAL{i} {code:g}" for i, code in ports.items() if code is not None) or "none"
    text = f"no port speaks MAVLink at {baud} baud (MAVLink: {port_bauds})"
    return Line(check="serial port", status=CheckStatus.WARN, text=text, fix="compare link.baud and SERIALn_BAUD")


def _identity(context: Context) -> Line:
    if context.link.sysid == context.sysid:
        return ok("system id", f"{context.sysid}, ours and the autopilot's")
    text = (
        f"ours is {context.link.sysid}, the autopilot's is {context.sysid}: ground stations show us as another vehicle"
    )
    return Line(check="system id", status=CheckStatus.WARN, text=text, fix=f"set link.sysid = {context.sysid}")
