"""Says hello ten times a second on /chatter; Ctrl-C ends it."""

import rmpa

with rmpa.connect("talker") as node:
    chatter = node.advertise("/chatter", "std_msgs/String")
    for count in node.rate(10):
        chatter.publish(data=f"hello {count}")
        if count % 10 == 0:
            node.logger.info("said hello %d times", count + 1)
