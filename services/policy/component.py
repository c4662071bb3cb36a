"""The declaration of the service that runs policies: see `cocoro.component`."""

from cocoro.component import Component
from cocoro.topics import ARM_STATE, BASE_STATE, FRAME, HAND_STATE, INTENT, POLICY_ACTIONS

POLICY = Component(
    name="policy",
    module="services.policy.service",
    doc="Runs a learned policy while the task `policy` wants one, and proposes its actions to the planner.",
    reads=(INTENT, FRAME, BASE_STATE, ARM_STATE, HAND_STATE),
    publishes=(POLICY_ACTIONS,),
    needs=("kinect", "base", "arm", "hand"),
    optional=True,
    frames="reads",
    nice=5,
    cpu_share=1.0,
    rss_mb=400.0,
    libraries=("numpy",),
)
