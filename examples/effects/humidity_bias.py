from stitch.effects import effect, number


@effect("sensor", needs=("humidity_percent",), k=number("mm", 0.01, 0.5))
def humidity_bias(points, view, k):
    """x = x* + u·k·(H−H₀), u along the ray, H in percent"""
    return points + view.along(points) * (k * view.since_first("humidity_percent"))
