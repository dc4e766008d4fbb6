"""Commands that a person runs beside a run: evaluate, render, figure, report, simulate, doctor …"""
