"""The simulated Calliope and its world. It uses the topics of the real hardware, so services cannot tell them apart."""
