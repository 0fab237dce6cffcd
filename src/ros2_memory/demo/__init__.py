"""`ros2-memory demo`: the whole product on a simulated robot whose answers are known.

    robot             the flat, and the robot's motion and sensors, as closed forms of time
    published_topics  the topics, and when each has a message
    messages          the robot's state as serialized ROS 2 messages
    recording         bags of those messages, with the layout of `ros2 bag record`
    questions         what the client asks; judges: whether the answers are right
    run               recorder, query server as a child process and client together; what is printed

No ROS installation and no configuration are needed.
"""
