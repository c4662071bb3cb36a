"""Hosts with a network between them on one machine, for tests, benches and first steps with several machines.

Each host has namespaces of its own (network, mounts, host name) and one device, a TUN device. A process, the switch,
reads the IP packets of all devices and writes each to the device of its destination, as late, as seldom and as slowly
as the way there is set to. It does so in user space, since many kernels have no netem. Needs root and /dev/net/tun, and
installs nothing. `sim/network/network.py` has what callers use; `python -m sim.network` makes a network by hand.
"""
