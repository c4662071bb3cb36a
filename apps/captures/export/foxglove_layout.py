"""The layout that Foxglove opens a robot with: camera and scene, the stop, the reason for what it does, plots and log.

`python -m apps.captures.export.foxglove_layout > docs/foxglove-layout.json` makes the file of the project's robot.
"""

from __future__ import annotations

from foxglove import layouts as fl

from apps.captures.export.foxglove_scene import BODY, MAP

ROBOT = "calliope"
STOP = "/stop"
FETCH = "/task/fetch"
SCENES = ("/robot/chassis", "/robot/links", "/planned", "/believed")
_STATUS = "planning/status"


def layout(robot: str = ROBOT) -> str:
    """The layout for the robot of a name: the text of a JSON file that Foxglove imports."""
    left = _split("column", (0.5, _camera()), (0.5, _plots(robot)))
    right = _split("column", (0.62, _scene()), (0.38, _words(robot)))
    whole = _split("row", (0.42, left), (0.58, right))
    return fl.Layout(content=whole).to_json()


def _camera() -> fl.ImagePanel:
    mode = fl.ImageModeConfig(
        image_topic="/camera/colour",
        calibration_topic="/camera/calibration",
        annotations={"/camera/annotations": fl.ImageAnnotationSettings(visible=True)},
        synchronize=False,
    )
    return fl.ImagePanel(title="Camera", config=fl.ImageConfig(image_mode=mode))


def _scene() -> fl.ThreeDeePanel:
    shown: dict[str, fl.BaseRendererTopicSettings] = {
        name: fl.BaseRendererSceneUpdateTopicSettings(visible=True) for name in SCENES
    }
    shown["/map"] = fl.BaseRendererGridTopicSettings(visible=True, color_mode="rgba-fields", draw_behind=True)
    shown["/camera/points"] = fl.BaseRendererPointCloudTopicSettings(
        visible=True, cube_outline=False, point_shape="circle", point_size=2.0, color_mode="rgba-fields"
    )
    seen_from = fl.ThreeDeeCameraState(distance=4.0, perspective=True, phi=50.0, theta_offset=90.0)
    config = fl.ThreeDeeConfig(
        topics=shown, follow_tf=BODY, fixed_frame=MAP, follow_mode="follow-position", camera_state=seen_from
    )
    return fl.ThreeDeePanel(title="Robot, map and way", config=config)


def _plots(robot: str) -> fl.TabContainer:
    def plot(**paths: str) -> fl.PlotPanel:
        series = [fl.PlotSeries(value=f"{robot}/{path}", label=label, enabled=True) for label, path in paths.items()]
        return fl.PlotPanel(config=fl.PlotConfig(paths=series, show_legend=True, following_view_width=20.0))

    return fl.TabContainer(
        selected_tab_index=0,
        tabs=[
            fl.TabItem(
                title="Drive",
                content=plot(speed_mps="base/state.speed_mps", turn_radps="base/state.turn_rate_radps"),
            ),
            fl.TabItem(
                title="Battery", content=plot(charge="base/state.battery_fraction", distance_m=f"{_STATUS}.distance_m")
            ),
        ],
    )


def _words(robot: str) -> fl.SplitContainer:
    why = fl.RawMessagesPanel(
        title="What it does, and why", config=fl.RawMessagesConfig(topic_path=f"{robot}/{_STATUS}.why")
    )
    log = fl.LogPanel(title="Log", config=fl.LogConfig(topic_to_render="/log"))
    stop = fl.ServiceCallPanel(
        title="Emergency stop",
        config=fl.ServiceCallConfig(
            service_name=STOP, request_payload="{}", button_text="STOP", button_color="#c81e1e", timeout_seconds=5.0
        ),
    )
    fetch = fl.ServiceCallPanel(
        title="Fetch (with --operate)",
        config=fl.ServiceCallConfig(
            service_name=FETCH, request_payload='{"label": "red_can"}', button_text="Fetch", timeout_seconds=5.0
        ),
    )
    asked = _split("column", (0.5, stop), (0.5, fetch))
    return _split("row", (0.3, asked), (0.35, why), (0.35, log))


def _split(direction: str, *parts: tuple[float, fl.Content]) -> fl.SplitContainer:
    items = [fl.SplitItem(proportion=share, content=content) for share, content in parts]
    return fl.SplitContainer(direction="row" if direction == "row" else "column", items=items)


if __name__ == "__main__":
    print(layout())
