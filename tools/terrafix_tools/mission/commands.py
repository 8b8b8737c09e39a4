"""MAVLink commands of missions: which of them a vehicle flies to. Numbers: MAV_CMD and MAV_FRAME of MAVLink common.xml
and ardupilotmega.xml."""

TAKE_OFFS = {22, 24, 84}  # NAV_TAKEOFF, NAV_TAKEOFF_LOCAL, NAV_VTOL_TAKEOFF
LANDS = {21, 85}  # NAV_LAND, NAV_VTOL_LAND
# way points of all kinds: followed, loitered over to an altitude, orbited, flown in a figure of eight, an arc or a
# spline to, payload place, start of the way back, start of a landing, reposition, deployment of a payload, user
FLOWN_TO = {16, 17, 18, 19, 31, 34, 35, 36, 81, 82, 94, 188, 189, 192, 252, 30001, *range(31000, 31005)} | LANDS
LAST_NAV = 95  # MAV_CMD_NAV_LAST: an unknown command up to it is flown to if it has a position
RADIUS_PARAM = {17: 2, 18: 2, 19: 2, 31: 1, 34: 0, 35: 0}  # index of the parameter with the radius of a circle, metres
RETURN, JUMP_TAG, SET_HOME, JUMP, JUMP_TO_TAG = 20, 600, 179, 177, 601
METRIC = {23, 24}  # NAV_LAND_LOCAL, NAV_TAKEOFF_LOCAL: their position is in metres
# commands that do not move a vehicle to their position: conditions, payload, camera, gimbal, regions of interest,
# servos, relays, fences, rally points, scripts, parameters
OTHERS = {
    25, 30, 32, 33, 80, 83, 92, 93, 95, *range(112, 116), 159, *range(176, 188), 190, 191, *range(193, 199),
    *range(200, 219), *range(220, 225), *range(240, 247), 260, 262, 300, 310, 311, 400, 401, 405, 406, 410, 420, 500,
    510, 511, 512, *range(519, 523), *range(525, 535), 600, 601, 610, 611, 1000, 1001, *range(2000, 2006), 2010, 2020,
    2021, *range(2500, 2506), 2510, 2511, 2520, 2600, 2800, 3000, 3001, 4000, 4001, 4501, *range(5000, 5006), 5100,
    5200, 5300, 10001, 10151, 30002, *range(31005, 31015), 32000, 40001, 40002, *range(42000, 42008),
    *range(42424, 42430), 42501, 42502, 42503, 42505, 42600, 42650, 42651, *range(42700, 42704), *range(43000, 43006),
    50000, 50001, 60002, 60010, 60020, *range(60050, 60054), *range(60070, 60074),
}  # fmt: skip
KNOWN = FLOWN_TO | TAKE_OFFS | METRIC | OTHERS | {RETURN}

GLOBAL_INT = {5, 6, 11}  # MAV_FRAME_GLOBAL_INT, _RELATIVE_ALT_INT, _TERRAIN_ALT_INT: a position may be in 1e-7 degrees
LOCAL = {1, 4, 7, 8, 9, 12, *range(13, 22)}  # MAV_FRAME_LOCAL_NED, ...: a position is in metres
NEAR_HOME_DEG = 2.0  # a position in a local frame this near to home is in degrees: nobody flies 200 km on a mission
