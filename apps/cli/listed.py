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


_SUMMARIES = {
    TASKS: {
        "cancel": "End the running task; the robot stands still.",
        "wait": "Follow a task to its end, and exit as its own command would have.",
        "drive": "Drive by hand with the keys of this terminal: base, head, arm and claws.",
        "rehearse": "Try a task in simulation: the whole robot in one process, in virtual time.",
    },
    WATCH: {
        "status": "The running services, their health, the task and the planner's reason.",
        "objects": "The objects that the robot knows, and where it saw each last; `learn` adds one.",
        "snapshot": "Write a picture of what the robot sees now, with its detections drawn in.",
        "topics": "List the topics and requests of all components: type, rate, age, quality of service, publisher.",
    },
    CAPTURES: {
        "capture": "List captures, look at them, keep, repair and re-execute them.",
        "record": "Record what travels on the mesh into MCAP files, until Ctrl-C.",
        "replay": "Send a capture into the mesh again.",
        "export": "Turn a capture into a film, tables, a file for Foxglove or Rerun; captures into a LeRobotDataset.",
        "view": "Open Rerun on a capture, or live on the mesh; or serve the robot to Foxglove.",
    },
    TOOLS: {
        "top": "Services and topics, live: cpu, memory, rates against nominal, ages; what was skipped, lost, rejected.",
        "echo": "Messages of a key, decoded, of any type; one that a reader would reject is marked with the reason.",
        "hz": "Rate, jitter and amount of data on a key, as it arrives here, over the last seconds.",
        "logs": "Logs of the robot's processes on this machine since their start, merged by time.",
        "cockpit": "Let persons into the cockpit from other machines; list them, end it.",
        "site": "Check the plan of several machines; show it, its steps and its rules.",
        "pki": "Issue, renew and revoke the certificates of a site; list them.",
        "new": "Write a component (`new service NAME`), a task (`new task NAME`) or a robot (`new robot NAME`).",
    },
    HARDWARE: {
        "base": "Show the base: mode, battery, bumpers, odometry; `recover` puts it back into its mode.",
        "servos": "Find, set up, calibrate, hold and relax the servos; clear their faults.",
        "kinect": "Calibrate the Kinect; tilt it.",
        "doctor": "Check a machine and its robot before a run; each line is well, or says what to do.",
    },
    LEARNING: {
        "babble": "Move to collect samples for learning: the arm with the hand in view, the wheels with a target.",
        "learn": "Learn a model for the planner from the samples of babbling.",
        "experiment": "Run the paper's experiments in virtual time and report them beside its text and baselines.",
    },
    RUNNING: {
        "up": "Start a robot's processes and stay until Ctrl-C (or, with --detach, until they are ready).",
        "down": "Stop a robot's processes.",
        "run": "Run one process in this terminal, on the mesh of the profile.",
    },
    SAFETY: {
        "stop": "Emergency stop, now: everything that moves stands still until `reset`.",
        "estop": "Emergency stop: the same command as `stop`.",
        "reset": "Release the emergency stop.",
    },
}

COMMANDS = tuple(
    CommandRow(name, panel, summary) for panel, commands in _SUMMARIES.items() for name, summary in commands.items()
)
