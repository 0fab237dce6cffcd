"""`ros2-memory demo`: the whole product on a simulated robot whose answers are known.

    robot             the flat, and the robot's motion and sensors, as closed forms of time
    messages          its topics, when each has a message, and what is in it
    recording         bags of those messages, with the layout of `ros2 bag record`
    questions         what the client asks, and whether the answers are right
    run               recorder, query server as a child process and client together; what is printed

No ROS installation and no configuration are needed.
"""
