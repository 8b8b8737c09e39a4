"""The process table: which processes run, and which messages each one subscribes to and publishes.

A process is a node (a function of messages) in a shell that owns clock, sockets and files. ``module`` is the name of a
module that is imported in the child process, so that a failing import does not end the supervisor."""

from dataclasses import dataclass

from terrafix import messages as m


@dataclass(frozen=True)
class Process:
    name: str
    module: str  # defines make_node(ctx: NodeContext) -> Node and optionally make_edge(ctx) -> Edge (sockets, files)
    subscribes: tuple[type[m.Message], ...]
    publishes: tuple[type[m.Message], ...]
    tick_hz: float  # rate of tick(); 0 = tick() is not called
    # A process without progress for this long is killed and restarted; what it waits for a processor does not count.
    stuck_after_s: float
    newest: tuple[type[m.Message], ...] = ()  # types of which only the newest is kept in the queue (runtime/inbox.py)
    nice: int = 0  # above 0: gets what the processes with 0 leave of a busy processor


SMOOTHER = "smoother"  # the process that `[smoother] enabled = false` leaves out

# Publishers besides the processes of the table.
SOURCE = "source"  # publisher of the messages that are fed into the in-process shell
SUPERVISOR = "supervisor"  # publishes ProcessEvent
OPERATOR = "operator"  # a command on this computer that publishes PositionHint; usually not running

# Processes start in this order and stop in the reverse order, so that the recorder receives the last messages of all.
PROCESSES: tuple[Process, ...] = (
    Process("recorder", "terrafix.recorder.node", m.ALL_MESSAGES, (), 1.0, 15.0),
    Process("health", "terrafix.health.node", (), (m.ThermalReading, m.Health), 1.0, 15.0),
    Process(
        "link",
        "terrafix.link.node",
        (
            m.Origin,
            m.NavEstimate,
            m.CalibrationFault,
            m.CameraVehicle,
            m.SearchState,
            m.HintVerdict,
            m.InitialPosition,
            m.Health,
            m.ProcessEvent,
        ),
        (
            m.VehicleState,
            m.Imu,
            m.GimbalAttitude,
            m.Exposure,
            m.PositionHint,
            m.EkfDeadReckoning,
            m.GpsInput,
            m.MeasurementVerdict,
            m.LinkStatus,
            m.CalibrationFault,
            m.ServedVehicle,
            m.CandidateAttitude,
            m.GnssReading,
            m.GnssInitialPosition,
            m.GnssVerdict,
            m.MapOffset,
            m.PositionSource,
            m.EkfStatus,
            m.WallClock,
            m.StatusText,
        ),
        50.0,  # GPS_INPUT is sent at 10 Hz; the finer tick reduces the jitter of its interval
        1.0,  # the tenth GPS_INPUT in a row that is missing; with the restart the autopilot waits for less than 2 s
    ),
    Process(
        "estimator",
        "terrafix.estimator.node",
        (
            m.Origin,
            m.InitialPosition,
            m.Frame,
            m.VehicleState,
            m.Imu,
            m.GimbalAttitude,
            m.ServedVehicle,
            m.CandidateAttitude,
            m.EkfDeadReckoning,
            m.PositionHint,
            m.Odometry,
            m.Relocalization,
            m.MapMatch,
            m.Health,
            m.SourceEnded,
        ),
        (
            m.Prediction,
            m.NavEstimate,
            m.PoseSolution,
            m.CalibrationFault,
            m.CameraVehicle,
            m.CalibrationEstimate,
            m.ClaimBudget,
            m.PoseLink,
            m.PoseAnchor,
            m.Refinement,
            m.MeasurementVerdict,
            m.InputOrder,
        ),
        0.0,
        6.0,  # an update takes milliseconds, one with a relocalisation tenths of a second
        (m.Odometry,),  # a frame that waits while a newer one is there only delays that one
    ),
    Process(
        SMOOTHER,
        "terrafix.smoother.node",
        (m.Origin, m.Prediction, m.PoseLink, m.PoseAnchor),
        (m.Refinement, m.InputOrder),
        0.0,
        30.0,
        nice=10,
    ),
    Process(
        "anchor",
        "terrafix.anchor.node",
        (m.Origin, m.Prediction, m.PositionHint, m.GnssInitialPosition, m.Health),
        (m.MapMatch, m.ModelEvent, m.SearchState, m.SearchPlaces, m.HintVerdict, m.InitialPosition),
        0.0,
        90.0,  # one correlation over a large map takes seconds, half a minute on a computer with ten times the load
        (m.Prediction,),
        nice=5,  # odometry and estimates do not wait for a map match
    ),
    Process(
        "vision",
        "terrafix.vision.node",
        (m.Origin, m.Frame, m.NavEstimate, m.Health, m.Exposure),
        (
            m.Origin,
            m.SourceFacts,
            m.Frame,
            m.VehicleState,
            m.Imu,
            m.GimbalAttitude,
            m.SourceEnded,
            m.Odometry,
            m.Relocalization,
            m.ModelEvent,
            m.CalibrationFault,
            m.FrameRate,
        ),
        0.0,
        10.0,  # the first photo of 26 megapixels takes 1.6 s; a camera is read and opened by a thread of its own
    ),
)
