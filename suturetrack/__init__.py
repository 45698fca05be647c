"""Finds a suture thread in stereo images from one seed point and holds a NURBS curve on it.

Images and numbers in, curves out: nothing in this package knows a clock, a network or a recorder.
The method is that of Jackson, Yuan, Chow, Newman and Cavusoglu (2015); "eq. n" and "Algorithm 1"
refer to that paper throughout.
"""
