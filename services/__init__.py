"""One folder a service: a thin asynchronous shell (`service.py`) over pure, synchronous modules."""
