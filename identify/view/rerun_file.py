"""A view as data of Rerun, with the blueprint that arranges it."""

import errno
from pathlib import Path

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from armident.arrays import Array
from armident.identify.view.arm import colours
from armident.identify.view.contents import Contents, Times

GREY = (150, 150, 150, 110)
"""Colour of the links: the joints are seen through them."""


def blueprint(view: Contents) -> rrb.Blueprint:
    """Return the arrangement: arm and findings on the left, one diagram for each quantity on the right."""
    arm = rrb.Spatial3DView(origin="arm", name="Arm")
    left = rrb.Vertical(arm, rrb.TextDocumentView(origin="findings", name="Findings"), row_shares=[3, 2])
    right = rrb.Vertical(*(rrb.TimeSeriesView(origin=plot.path, name=plot.title) for plot in view.plots))
    return rrb.Blueprint(rrb.Horizontal(left, right, column_shares=[2, 3]), collapse_panels=True)


def write_rrd(view: Contents, file: Path) -> None:
    """Write a view to a file; OSError if it cannot be written as a whole."""
    stream = rr.RecordingStream("armident")
    try:
        stream.save(file, default_blueprint=blueprint(view))
        _send(view, stream)
        stream.flush()
        stream.disconnect()
    except RuntimeError as error:
        raise OSError(errno.EIO, str(error)) from error


def _send(view: Contents, stream: rr.RecordingStream) -> None:
    """Send the data of a view; time lines: ``time`` (UTC) and ``since_start``."""
    begin = view.poses[0][0]

    def send_columns(path: str, t_ns: Times, columns: rr.ComponentColumnList) -> None:
        time = rr.TimeColumn("time", timestamp=t_ns.astype("datetime64[ns]"))
        since_start = rr.TimeColumn("since_start", duration=(t_ns - begin).astype("timedelta64[ns]"))
        stream.send_columns(path, [time, since_start], columns)

    stream.log("findings", rr.TextDocument(view.findings, media_type=rr.MediaType.MARKDOWN), static=True)
    for plot in view.plots:
        for name, (t_ns, values) in plot.curves.items():
            stream.log(f"{plot.path}/{name}", rr.SeriesLines(names=name), static=True)
            send_columns(f"{plot.path}/{name}", t_ns, rr.Scalars.columns(scalars=values))
    stream.log("arm", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    stream.log("arm/link", _mesh(view.arm.links[0]), static=True)
    translations, quaternions = view.arm.poses(view.poses[1])
    turns, radius, height = view.arm.axes
    path = "arm"
    for j, joint in enumerate(view.robot.joints):
        # Below the link that carries it, whose frame it moves in.
        path = f"{path}/{joint.name}"
        moved = rr.Transform3D.columns(translation=translations[:, j], quaternion=quaternions[:, j])
        send_columns(path, view.poses[0], moved)
        stream.log(f"{path}/link", _mesh(view.arm.links[j + 1]), static=True)
        stream.log(f"{path}/axis", rr.Cylinders3D(lengths=height, radii=radius, quaternions=turns[j]), static=True)
        if view.levels is not None:
            shades = rr.Cylinders3D.columns(colors=colours(view.levels[1][:, j]))
            send_columns(f"{path}/axis", view.levels[0], shades)


def _mesh(triangles: Array) -> rr.Mesh3D:
    """Return a mesh of triangles (K, 3, 3), each with its own normal."""
    normals = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), np.finfo(float).tiny)
    each = np.repeat(normals, 3, axis=0)
    return rr.Mesh3D(vertex_positions=triangles.reshape(-1, 3), vertex_normals=each, albedo_factor=GREY)
