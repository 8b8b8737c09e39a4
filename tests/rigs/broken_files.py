"""Files of users with one mistake each: kind, text, and the key that a message has to name."""

from terrafix_tools.configuration.schema import CAMERA, CONFIG, FLIGHT

CAMERA_LINES = "[camera]\nwidth = 1280\nheight = 720\nfx = 914.0\nfy = 914.0\ncx = 640.0\ncy = 360.0\n"


def changed(line: str, to: str) -> str:
    """The camera of CAMERA_LINES with one line changed."""
    assert line in CAMERA_LINES
    return CAMERA_LINES.replace(line, to)


_CONFIG = (
    "[map]\npaht = ''", "[map]\npath = 3", "[map]\nce90_m = -1.0", "[map]\nce90_m = 500", "[map]\nce90_m = 'ten'",
    "[map]\nrequire_signature = 'yes'", "[map]\ntrusted_keys = 'a.pub'", "[models]\nxfeat = true",
    "[models]\ncorrelation = 'cuda'", "[models]\nfolder = 1", "[places]\nsearch = 'fast'", "[places]\nindex = []",
    "[vision]\nfeatures = 1", "[source]\nrate_hz = 0", "[source]\nrate_hz = 240", "[source]\nrealtime = 1",
    "[source]\nlatency_ms = -5", "[source]\nstart = [48.0, 11.0]", "[source]\ncamera = 1", "[link]\nbuad = 57600",
    "[link]\nbaud = 300", "[link]\nbaud = '57600'", "[link]\nsysid = 0", "[link]\nsysid = 256", "[link]\ncompid = 1.5",
    "[link]\ngps_id = 4", "[link]\nrate_hz = 50", "[link]\noutputs = ['gps']", "[link]\ngnss = 'on'",
    "[link]\ndevice = 14550", "[link]\nground_devices = 'udpout:1.2.3.4:1'", "[recorder]\nframes = 'some'",
    "[recorder]\nframe_format = 'gif'", "[recorder]\nthumbnail_width_px = 10", "[recorder]\nbudget_mb = 1",
    "[health]\nhot_c = 200", "[health]\nhot_match_every = 0", "[runtime]\ncores = -1", "[smoother]\nenabled = 'no'",
    "[log]\nlevel = 'LOUD'", "[helth]\nhot_c = 70.0",
)  # fmt: skip
_DESCRIPTIONS = (
    (CAMERA, changed("width = 1280", "width = 0"), "width"),
    (CAMERA, changed("width = 1280\n", ""), "width"),
    (CAMERA, changed("fx = 914.0", "fx = -914.0"), "fx"),
    (CAMERA, changed("fx = 914.0", "f = 914.0"), "'f'"),
    (CAMERA, changed("cx = 640.0", "cx = 'middle'"), "cx"),
    (CAMERA, CAMERA_LINES + "model = 'omni'", "model"),
    (CAMERA, CAMERA_LINES + "distortion = 0.1", "distortion"),
    (CAMERA, CAMERA_LINES + "focal_sigma = 2.0", "focal_sigma"),
    (CAMERA, CAMERA_LINES + "[mount]\npitch = -90.0", "pitch"),
    (CAMERA, CAMERA_LINES + "[mount]\ntolerance_deg = 0", "tolerance_deg"),
    (CAMERA, CAMERA_LINES + "[mount]\ngimbal = 'yes'", "gimbal"),
    (CAMERA, CAMERA_LINES + "[mount]\nyaw_deg = 400", "yaw_deg"),
    (FLIGHT, "[start]\nlat_deg = 95.0\nlon_deg = 11.0", "lat_deg"),
    (FLIGHT, "[start]\nlat_deg = 48.0", "lon_deg"),
    (FLIGHT, "[start]\nlat_deg = 48.0\nlon_deg = 11.0\nsigma_m = 0", "sigma_m"),
    (FLIGHT, "[start]\nlat_deg = 48.0\nlon_deg = 11.0\nground_amsl_m = 99999", "ground_amsl_m"),
    (FLIGHT, "version = 2\nname = 'a'", "version"),
    (FLIGHT, "[telemetry]\nyaw_sigma_deg = 0", "yaw_sigma_deg"),
    (FLIGHT, "[telemetry]\nsystem_id = 300", "system_id"),
)


def _key(text: str) -> str:
    section, line = text.split("\n", 1)
    return "helth" if section == "[helth]" else line.split(" = ")[0]


BROKEN = (*((CONFIG, text, _key(text)) for text in _CONFIG), *_DESCRIPTIONS)
