"""Commands that are not part of a run: evaluate, render, figure, report, simulate, doctor …"""
