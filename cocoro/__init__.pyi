# What type checkers see of the package: its names are found at run time, see __init__.py.

from apps.client.blocking import connect_blocking as connect_blocking
from apps.client.connecting import connect as connect
from apps.client.opening import open as open
from apps.client.rehearsing import rehearse as rehearse
from cocoro.api import *

__all__: list[str]
