"""Emulated MCUs: the same firmware without a robot, in virtual time or live on a port."""
