"""Fits of an arm joint by joint, along the measured motion of the other joints."""
