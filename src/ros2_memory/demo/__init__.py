"""`ros2-memory demo`: the whole product at work on a robot whose every answer is known.

    flat        the rooms, walls and things that a robot drives among
    robot       where the robot is and what it senses: closed forms of time
    streams     which topic carries a message when
    messages    a moment of the robot as a serialized ROS 2 message
    recording   bags of those messages, laid out as `ros2 bag record` lays them out
    questions   what a client asks, and what is right
    run         recorder, query server and client together

No ROS installation and no configuration are needed.
"""
