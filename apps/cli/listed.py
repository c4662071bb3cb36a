"""The commands of `cocoro` that are not tasks, in the order in which its help lists them."""

from __future__ import annotations

from typing import NamedTuple

TASKS, WATCH, RUNNING, SAFETY = "Tasks", "Watching", "Starting and stopping", "Safety"
CAPTURES, TOOLS, HARDWARE, LEARNING = "Captures", "Tools", "Hardware", "Learning"


class CommandRow(NamedTuple):
    """A command as `cocoro --help` lists it. The summary begins the command's own help, too."""

    name: str
    panel: str
    summary: str
    hidden: bool = False


COMMANDS = (
    CommandRow("cancel", TASKS, "End the running task; the robot stands still."),
    CommandRow("wait", TASKS, "Follow a task to its end, and exit as its own command would have."),
    CommandRow("rehearse", TASKS, "Try a task in simulation: the whole robot in one process, in virtual time."),
    CommandRow("status", WATCH, "The running services, their health, the task and the planner's reason."),
    CommandRow("objects", WATCH, "The objects that the robot knows, and where it saw each last; `learn` adds one."),
    CommandRow("snapshot", WATCH, "Write a picture of what the robot sees now, with its detections drawn in."),
    CommandRow(
        "topics",
        WATCH,
        "List the topics and requests of all installed components: type, rate, age, quality of service, publisher.",
    ),
    CommandRow("capture", CAPTURES, "List captures, look at them, keep, repair and re-execute them."),
    CommandRow("record", CAPTURES, "Record what travels on the mesh into MCAP files, until Ctrl-C."),
    CommandRow("replay", CAPTURES, "Send a capture into the mesh again."),
    CommandRow(
        "export",
        CAPTURES,
        "Turn a capture into a film, tables, or a file for Foxglove or Rerun; or extract its attachments.",
    ),
    CommandRow("view", CAPTURES, "Open Rerun on a capture, or live on the mesh."),
    CommandRow(
        "top",
        TOOLS,
        "Services and topics, live: cpu, memory, rates against nominal, ages, and what was skipped, lost or rejected.",
    ),
    CommandRow(
        "echo",
        TOOLS,
        "The messages of a key, decoded, of any type; a message that a reader would reject is marked with the reason.",
    ),
    CommandRow("hz", TOOLS, "Rate, jitter and amount of data on a key, as it arrives here, over the last seconds."),
    CommandRow("logs", TOOLS, "Logs of the robot's processes on this machine since their start, merged by time."),
    CommandRow("new", TOOLS, "Write a component (`new service NAME`) or a task (`new task NAME`) from a template."),
    CommandRow(
        "base", HARDWARE, "Show the base: mode, battery, bumpers, odometry; `recover` puts it back into its mode."
    ),
    CommandRow("servos", HARDWARE, "Find, set up, calibrate, hold and relax the servos; clear their faults."),
    CommandRow("kinect", HARDWARE, "Calibrate the Kinect; tilt it."),
    CommandRow(
        "doctor", HARDWARE, "Check a machine and its robot before a run; each line is well, or says what to do."
    ),
    CommandRow(
        "babble",
        LEARNING,
        "Move to collect samples for learning: the arm with the hand in view, the wheels with a target.",
    ),
    CommandRow("learn", LEARNING, "Learn a model for the planner from the samples of babbling."),
    CommandRow(
        "experiment",
        LEARNING,
        "Run the paper's experiments in virtual time and report them beside the paper's text and baselines.",
    ),
    CommandRow(
        "up", RUNNING, "Start a robot's processes and stay until Ctrl-C (or, with --detach, until they are ready)."
    ),
    CommandRow("down", RUNNING, "Stop a robot's processes."),
    CommandRow("run", RUNNING, "Run one process in this terminal, on the mesh of the profile."),
    CommandRow("estop", SAFETY, "Emergency stop, now: everything that moves stands still until `reset`."),
    CommandRow("stop", SAFETY, "Short for estop.", hidden=True),
    CommandRow("reset", SAFETY, "Release the emergency stop."),
)
