"""Who runs and who hears what: the process table.

A process is a node (a function of messages) in a shell that owns clock, sockets and files. ``module`` is
named by string and imported in the child, so that one broken import cannot take the supervisor down."""

from dataclasses import dataclass

from terrafix import messages as m


@dataclass(frozen=True)
class Process:
    name: str
    module: str  # has make_node(ctx: NodeContext) -> Node; may have make_edge(ctx) -> Edge (its sockets and files)
    subscribes: tuple[type[m.Message], ...]
    publishes: tuple[type[m.Message], ...]
    tick_hz: float  # how often tick() is called; 0 = only messages
    stuck_after_s: float  # no progress for this long counts as dead
    newest: tuple[type[m.Message], ...] = ()  # a backlog of these becomes the newest one (see runtime/inbox.py)


# Who else speaks.
SOURCE = "source"  # who "says" what is fed into the in-process shell
SUPERVISOR = "supervisor"  # says ProcessEvent
OPERATOR = "operator"  # a command on this computer that says PositionHint; seldom there

EVERYTHING: tuple[type[m.Message], ...] = (
    m.Origin,
    m.Frame,
    m.VehicleState,
    m.Imu,
    m.SourceEnded,
    m.Odometry,
    m.Prediction,
    m.MapMatch,
    m.ModelEvent,
    m.SearchState,
    m.PositionHint,
    m.Coasted,
    m.HintVerdict,
    m.Start,
    m.NavEstimate,
    m.CalibrationFault,
    m.SlowErrors,
    m.Refinement,
    m.MeasurementVerdict,
    m.GpsInput,
    m.LinkStatus,
    m.GnssReading,
    m.GnssStart,
    m.GnssVerdict,
    m.MapOffset,
    m.PositionSource,
    m.FilterStatus,
    m.WallClock,
    m.StatusText,
    m.ThermalReading,
    m.Health,
    m.ProcessEvent,
    m.Dropped,
)

# Start order is this order; stop order is the reverse, so the recorder hears the last word of everybody.
PROCESSES: tuple[Process, ...] = (
    Process("recorder", "terrafix.recorder.node", EVERYTHING, (), 1.0, 15.0),
    Process("health", "terrafix.health.node", (), (m.ThermalReading, m.Health), 1.0, 15.0),
    Process(
        "link",
        "terrafix.link.node",
        (m.Origin, m.NavEstimate, m.CalibrationFault, m.SearchState, m.HintVerdict, m.Start, m.Health, m.ProcessEvent),
        (
            m.VehicleState,
            m.Imu,
            m.PositionHint,
            m.Coasted,
            m.GpsInput,
            m.MeasurementVerdict,
            m.LinkStatus,
            m.GnssReading,
            m.GnssStart,
            m.GnssVerdict,
            m.MapOffset,
            m.PositionSource,
            m.FilterStatus,
            m.WallClock,
            m.StatusText,
        ),
        50.0,  # GPS_INPUT leaves at 10 Hz; the finer tick keeps its interval steady
        2.0,
    ),
    Process(
        "estimator",
        "terrafix.estimator.node",
        (m.Origin, m.Start, m.Frame, m.VehicleState, m.Imu, m.Coasted, m.Odometry, m.MapMatch, m.Health, m.SourceEnded),
        (m.Prediction, m.NavEstimate, m.CalibrationFault, m.SlowErrors, m.Refinement, m.MeasurementVerdict),
        0.0,
        20.0,
    ),
    Process(
        "anchor",
        "terrafix.anchor.node",
        (m.Origin, m.Prediction, m.PositionHint, m.GnssStart),
        (m.MapMatch, m.ModelEvent, m.SearchState, m.HintVerdict, m.Start),
        0.0,
        90.0,  # one look over a large map takes seconds, and half a minute on a computer that is ten times as busy
        (m.Prediction,),
    ),
    Process(
        "vision",
        "terrafix.vision.node",
        (m.Origin, m.Frame),
        (m.Origin, m.Frame, m.VehicleState, m.Imu, m.SourceEnded, m.Odometry),
        0.0,
        30.0,
    ),
)
