"""An RTSP server as a program: python rtsp_server.py WIDTH HEIGHT [USER:PASSWORD]. Prints its port, and serves H.264 at
/camera, made anew for each connection, until its input ends. Exit code 3: GStreamer's server is not installed."""

import importlib
import sys
import threading
from typing import Any

from terrafix.vision.sources.gst import gstreamer

ABSENT = 3
ENCODER = "x264enc tune=zerolatency speed-preset=ultrafast key-int-max=10 ! rtph264pay name=pay0 pt=96"


def main(width: int, height: int, user: str = "") -> int:
    Gst, _ = gstreamer()
    try:
        gi: Any = importlib.import_module("gi")
        gi.require_version("GstRtspServer", "1.0")
        rtsp = importlib.import_module("gi.repository.GstRtspServer")
        glib = importlib.import_module("gi.repository.GLib")
    except (ImportError, ValueError):
        return ABSENT
    if not all(Gst.ElementFactory.find(name) for name in ("x264enc", "avdec_h264", "rtph264pay", "rtspsrc")):
        return ABSENT
    server, factory = rtsp.RTSPServer(), rtsp.RTSPMediaFactory()
    server.set_address("127.0.0.1")
    server.set_service("0")
    caps = f"video/x-raw,format=I420,width={width},height={height},framerate=30/1"
    factory.set_launch(f"( videotestsrc is-live=true pattern=ball ! {caps} ! {ENCODER} )")
    if user:
        name, password = user.split(":")
        auth, token, allowed = rtsp.RTSPAuth(), rtsp.RTSPToken(), rtsp.RTSPPermissions()
        token.set_string("media.factory.role", "pilot")
        auth.add_basic(rtsp.RTSPAuth.make_basic(name, password), token)
        server.set_auth(auth)
        for right in ("media.factory.access", "media.factory.construct"):
            allowed.add_permission_for_role("pilot", right, True)
        factory.set_permissions(allowed)
    server.get_mount_points().add_factory("/camera", factory)
    server.attach(None)
    sys.stdout.write(f"{server.get_bound_port()}\n")
    sys.stdout.flush()
    loop = glib.MainLoop()
    threading.Thread(target=lambda: (sys.stdin.read(), loop.quit()), daemon=True).start()
    loop.run()
    return 0


if __name__ == "__main__":
    sys.exit(main(int(sys.argv[1]), int(sys.argv[2]), *sys.argv[3:]))
