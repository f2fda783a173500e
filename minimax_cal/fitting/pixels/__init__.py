"""Calibration by cameras: detections of corners or tags, joints, and camera files, to an arm.

What pixels tell of the arm is judged by its positions, against how well the drawing is known: held
out pixels alone say nothing of it.
"""
