"""`ros2-memory demo`: the whole product on a simulated robot whose answers are known.

    floor_plan        rooms, walls and objects of the flat
    robot             the robot's motion and sensors, as closed forms of time
    published_topics  the topics, and when each has a message
    messages          the robot's state as serialized ROS 2 messages
    recording         bags of those messages, with the layout of `ros2 bag record`
    questions         what the client asks; judges, answer_checks: whether the answers are right
    server_process    the query server as a child process
    output            what is printed
    run               recorder, query server and client together

No ROS installation and no configuration are needed.
"""
