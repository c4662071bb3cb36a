"""The simulated Calliope and its world: it publishes and obeys exactly the hardware's keys."""
