"""A camera without a calibration, from five answers: size, focal length, tilt, top of the image, play of the mount."""

import math
import sys
from dataclasses import dataclass, replace

import typer

from terrafix.core.errors import UsageError
from terrafix.messages import Camera
from terrafix.vision.sources.description import FOCAL_SIGMA
from terrafix_tools.camera.describe import parse_size

TOP_YAW_DEG = {"nose": 0.0, "right": 90.0, "tail": 180.0, "left": -90.0}


@dataclass(frozen=True)
class Answers:
    """As typed; "" where not given."""

    size: str = ""  # 1280x720
    focal: str = ""  # 914px, 70deg (across the image), 4.5mm/6.3mm (focal length / width of the sensor)
    tilt: str = ""  # degrees from straight down towards the image top
    top: str = ""  # where the image top points: nose, tail, left, right
    tolerance: str = ""  # 1-sigma of the mount, degrees


QUESTIONS = {
    "size": ("Size of the frames, in pixels", "1280x720"),
    "focal": ("Focal length in pixels (914px), width of the view (70deg), or lens/sensor width (4.5mm/6.3mm)", "70deg"),
    "tilt": ("Tilt of the camera from straight down, degrees", "0"),
    "top": ("Where the top of the image points on the vehicle: nose, tail, left or right", "nose"),
    "tolerance": ("How far the mount may be off (1-sigma), degrees", "5"),
}


def asked(answers: Answers) -> Answers:
    """Asks for what is missing, at a terminal. Raises UsageError: there is none."""
    for key, (question, example) in QUESTIONS.items():
        if not getattr(answers, key):
            if not sys.stdin.isatty():
                raise UsageError(f"--{key} is missing; {question[0].lower()}{question[1:]}, such as {example}")
            answers = replace(answers, **{key: typer.prompt(question, default=example)})
    return answers


def camera_of_answers(answers: Answers) -> Camera:
    """Raises UsageError: an answer that is not understood."""
    size = parse_size(answers.size)
    assert size is not None  # asked
    if answers.top not in TOP_YAW_DEG:
        raise UsageError(f"--top {answers.top}: nose, tail, left or right")
    focal_px = _focal_px(answers.focal, size[0])
    return Camera(
        width=size[0],
        height=size[1],
        fx=focal_px,
        fy=focal_px,
        cx=(size[0] - 1) / 2,
        cy=(size[1] - 1) / 2,
        focal_sigma=FOCAL_SIGMA,
        mount_yaw_deg=TOP_YAW_DEG[answers.top],
        mount_pitch_deg=-90.0 + _number("tilt", answers.tilt),
        mount_tolerance_deg=_number("tolerance", answers.tolerance),
    )


def _focal_px(text: str, width: int) -> float:
    """Raises UsageError."""
    try:
        if text.endswith("px"):
            focal_px = float(text[:-2])
        elif text.endswith("deg"):
            focal_px = width / 2 / math.tan(math.radians(float(text[:-3])) / 2)
        else:
            lens, sensor = (float(part.removesuffix("mm")) for part in text.split("/"))
            focal_px = lens / sensor * width
    except (ValueError, ZeroDivisionError):
        focal_px = math.nan
    if not (math.isfinite(focal_px) and focal_px > 0.0):
        raise UsageError(f"--focal {text}: write 914px, 70deg (across the image) or 4.5mm/6.3mm (lens/sensor width)")
    return focal_px


def _number(name: str, text: str) -> float:
    """Raises UsageError."""
    try:
        return float(text.removesuffix("deg"))
    except ValueError:
        raise UsageError(f"--{name} {text}: write a number of degrees") from None
