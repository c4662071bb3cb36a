"""The command line's access to a robot's mesh, which is that of all clients."""

from apps.client.link import PERCEPTION as PERCEPTION
from apps.client.link import MeshLink as MeshLink
from apps.client.link import find as find
from apps.client.link import joined as joined
from cocoro.participant import Answer as Answer
