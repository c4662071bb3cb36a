"""The simulated Kinect in a process of its own, which draws a picture while everything else goes on.

`start` starts the process, `remote` is its owner's end, `serving` runs in it, `wire` is what they exchange. A Kinect
delivers a picture tens of milliseconds after its exposure: the poses of the moment of exposure go to the process at
once, and the picture is waited for when its delivery is due. It depends on its poses and its stamp alone, so it is the
one that `sim.camera.SimKinect` takes, however long it took.
"""
