"""Adds two numbers by the service /add_two_ints: python add_two_ints_client.py 2 3."""

import sys

import rmpa

a, b = map(int, sys.argv[1:])
with rmpa.connect("add_two_ints_client", anonymous=True) as node:
    node.wait_for_service("/add_two_ints", timeout=10)
    answer = node.call_service("/add_two_ints", "rospy_tutorials/AddTwoInts", {"a": a, "b": b})
    print(f"{a} + {b} = {answer.sum}")
