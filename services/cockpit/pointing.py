"""What is where somebody points: a known object, or a place on the floor."""

from __future__ import annotations

from math import hypot

from services.cockpit.asking import Reply
from services.cockpit.orders import PictureClick, What
from services.cockpit.scene import Scene

SLACK = 0.02
"""How far beside an object's box a click counts for it, as a share of the picture's width: fingers are wide."""
NEAR_M = 0.15
"""How far beside an object's centre a click on the map counts for it."""


def what(order: What, scene: Scene) -> Reply:
    """The object or the place that was pointed at."""
    if order.picture is not None:
        return _in_picture(order.picture, scene)
    if order.map is not None:
        return _on_map(order.map, scene)
    return Reply(False, "point at the picture or at the map")


def _in_picture(click: PictureClick, scene: Scene) -> Reply:
    marks = scene.marks(click.stamp_ns, click.width, click.height)
    slack = SLACK * click.width
    for mark in sorted(marks["detections"], key=lambda mark: hypot(mark["u"] - click.u, mark["v"] - click.v)):
        left, top, right, bottom = mark["box"]
        if left - slack <= click.u < right + slack and top - slack <= click.v < bottom + slack:
            return _object(mark["label"], scene)
    place = scene.sight.at(click.stamp_ns)
    if place is None:
        return Reply(False, "the picture is too old, or the angles of the head are not known")
    floor = place.floor_at(click.u, click.v, click.width, click.height)
    if floor is None:
        return Reply(False, "no place on the floor: it is above the horizon or too far away")
    return _place(floor)


def _on_map(place: tuple[float, float], scene: Scene) -> Reply:
    known = scene.plan.known if scene.plan is not None else ()
    near = [(hypot(one.odometry_position_m[0] - place[0], one.odometry_position_m[1] - place[1]), one) for one in known]
    nearest = min(near, key=lambda each: each[0], default=None)
    if nearest is not None and nearest[0] <= NEAR_M:
        return _object(nearest[1].label, scene)
    return _place(place)


def _object(label: str, scene: Scene) -> Reply:
    known = scene.plan.known if scene.plan is not None else ()
    where = next((one.odometry_position_m[:2] for one in known if one.label == label), None)
    place = None if where is None else [round(each, 3) for each in where]
    return Reply(True, label, {"label": label, "place": place, "text": label})


def _place(place: tuple[float, float]) -> Reply:
    x, y = (round(each, 3) for each in place)
    text = f"the floor at {x:.2f}, {y:.2f} m"
    return Reply(True, text, {"label": None, "place": [x, y], "text": text})
