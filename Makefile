# make demo   pick up tofu three times, leave a report in runs/demo/
# make demo CAMERA=1   the same, the block seen through a rendered camera only
# make test   lint, types and all tests
# make codesign   train a finger and its control from nothing
.PHONY: help setup demo test codesign lint clean
.DEFAULT_GOAL := help
SHELL := /bin/bash

help:
	@echo "make demo    set up if needed, pick up tofu over the ROS 2 graph, write runs/demo/report.html"
	@echo "make demo CAMERA=1  the policy sees the block through a rendered camera only"
	@echo "make test    set up if needed, lint, check types, run all tests"
	@echo "make codesign  train finger and control from nothing, and the stock gripper beside it"
	@echo "make setup   only set up: .venv/, dependencies, the colcon workspace"
	@echo "make clean   remove what set-up and runs have made"

setup:
	@bash scripts/setup.sh

demo: setup
	@. scripts/env.sh && codesign demo $(if $(filter-out 0,$(CAMERA)),--camera)

codesign: setup
	@. scripts/env.sh && bash scripts/codesign.sh

test: setup lint
	@. scripts/env.sh && python -m pytest tests

lint: setup
	@. scripts/env.sh && ruff check . && ruff format --check . && mypy

clean:
	rm -rf .venv runs ros_ws/build ros_ws/install ros_ws/log
