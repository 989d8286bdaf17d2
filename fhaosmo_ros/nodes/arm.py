# SPDX-License-Identifier: Apache-2.0
"""The arm node: external torques and contacts out of /joint_states and a URDF."""

from collections.abc import Mapping
from functools import partial
from time import perf_counter
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from fhaosmo_ros.core.arm.arm import Arm, ArmEstimate, payload_of, text_of
from fhaosmo_ros.core.parameters.declaration import Parameters, Value
from fhaosmo_ros.core.parameters.errors import ConfigurationError
from fhaosmo_ros.messages.joints import joint_sample
from fhaosmo_ros.nodes.middleware import diagnostics, endpoints
from fhaosmo_ros.nodes.middleware.diagnostics import ERROR, OK, QUIET, STALE, WARN
from fhaosmo_ros.nodes.middleware.endpoints import LATCHED, SENSOR_QOS
from fhaosmo_ros.nodes.middleware.messages import time_message
from fhaosmo_ros.nodes.middleware.node import BaseNode
from fhaosmo_ros.nodes.middleware.spin import run_node
from geometry_msgs.msg import Vector3, WrenchStamped
import numpy as np
from sensor_msgs.msg import JointState
from std_msgs.msg import String
from std_srvs.srv import Trigger

SILENT = 0.5  # seconds without a sample that are reported
FIELDS = {
    'external_torque': {'effort': 'external_torque'},
    'standard_deviation': {'effort': 'standard_deviation'},
    'joint_states': {'position': 'position', 'velocity': 'velocity'},
}
"""What the fields of a JointState are in `ArmEstimate`."""
SERVICES = {
    'reset': 'the estimates begin anew with the next sample',
    'tare': 'the present external torque counts as zero',
}
MEANT = {
    'beyond limits': 'positions lie beyond the limits of the URDF: are they in degrees, or is it '
    'another robot?',
    'jumped': 'positions jumped faster than three times the velocity limit of the URDF: the '
    'estimates began anew',
    'not finite': 'positions, efforts or velocities are NaN or infinite',
    'not newer': 'the stamp is not later than that of the sample before',
    'too strong': 'efforts are a hundred times those of the URDF: what is the unit of effort?',
    'too fast': 'velocities are more than three times the limit of the URDF: are they in degrees?',
    'standing still': 'positions stay the same to the last digit though the arm was moving: is '
    'the driver stuck?',
    'diverged': 'the estimated velocity became more than three times the limit of the URDF (are '
    'stamps and efforts right?): the estimates began anew',
    'clock set back': 'stamps are more than 0.1 s older than before: the estimates began anew',
    'restarts': 'a gap of more than 0.1 s: the estimates began anew',
}
"""What the counters of `Arm` mean."""


class ArmNode(BaseNode):
    """
    Estimates external torques, from the first sample after the robot's description on.

    `given` are values of parameters, also of rclpy's own. Those that can't be used raise
    ConfigurationError; what a topic delivers and can't be used is logged, reported and survived.
    """

    def __init__(self, given: Mapping[str, Any]) -> None:
        super().__init__('arm', given)
        values = self.values
        self._arm: Arm | None = None
        self._description = ''
        self._problems: dict[str, str] = {}  # of each kind the last one, since the last report
        self._log = diagnostics.ReportLog(self)
        self._published, self._latest = -np.inf, -np.inf
        self._contact: bool | None = False  # None: not known
        self._estimate: ArmEstimate | None = None
        kinds = dict.fromkeys(FIELDS, JointState) | {'event': DiagnosticArray}
        if values['wrench_frame']:
            kinds['external_wrench'] = WrenchStamped
        self._outputs = {
            topic: endpoints.create_publisher(self, kind, f'~/{topic}', latched=topic == 'event')
            for topic, kind in kinds.items()
        }
        self._listeners = endpoints.Listeners(self._outputs)
        if values['robot_description_file']:
            expected = "parameter 'robot_description_file': expected a URDF"
            self._use(text_of(values['robot_description_file'], expected))
        else:
            self._topic = self.resolve_topic_name('robot_description')
            self._missing = f'no robot yet on {self._topic}'
            self.create_subscription(String, 'robot_description', self._on_description, LATCHED)
            self.get_logger().info(f'waiting for the robot on {self._topic}')
        self.create_subscription(JointState, values['input_topic'], self._on_sample, SENSOR_QOS)
        for name in SERVICES:
            self.create_service(Trigger, f'~/{name}', partial(self._serve, name))
        diagnostics.publish_diagnostics(self, self._reports)

    def _use(self, urdf: str) -> None:
        """Begin to estimate for this robot."""
        values = self.values
        arm = Arm(urdf, values)
        if values['wrench_frame']:  # raises for an unknown one
            arm.model.frame_jacobian(np.zeros(len(arm.joints)), values['wrench_frame'])
        self._arm, self._description = arm, urdf
        self._messages = {topic: JointState(name=list(arm.joints)) for topic in FIELDS}
        self._tell(OK, 'no contact yet')
        self.get_logger().info(
            f'estimating the external torques of {", ".join(arm.joints)} from '
            f'{self.resolve_topic_name(values["input_topic"])} '
            f'({values["measurement"]}, effort: {values["effort"]})'
        )

    def _on_description(self, message: String) -> None:
        if self._arm is None:
            try:
                self._use(message.data)
            except ConfigurationError as error:
                self._missing = str(error)
        elif message.data != self._description:
            text = f'a second robot on {self._topic} is ignored: start the node again for it'
            self._problems['robot'] = text

    def _on_sample(self, message: JointState) -> None:
        """Take a message, if it is of this arm."""
        arm = self._arm
        if arm is None:
            return
        try:
            stamp, arrays = joint_sample(message, arm)
        except ConfigurationError as error:
            if not self._estimate or {*arm.joints} & {*message.name}:  # else of another robot
                self._problems['message'] = f'{error}: no estimate from it'
            return
        estimate = arm.take(stamp, *arrays)
        if arm.problem in MEANT:
            got = ', '.join(
                f'{what} {" ".join(f"{x:.3g}" for x in numbers)}'
                for what, numbers in zip(('position', 'effort', 'velocity'), arrays, strict=False)
            )
            self._problems[arm.problem] = f'{MEANT[arm.problem]} (got {got})'
        if arm.doubts.text:
            self._problems['doubts'] = arm.doubts.text
        if estimate is None:
            return
        self._latest, self._estimate = perf_counter(), estimate
        if estimate.contact != self._contact:
            self._contact, at = estimate.contact, estimate.link
            if self._contact:
                self._tell(WARN, f'contact, most likely at {at}', estimate)
            else:
                at = at and f', most likely it was at {at}'
                self._tell(OK, f'contact has ended{at}', estimate)
        # Half a sample early rather than one late: rates that divide each other stay as they are.
        if not 0.0 <= stamp - self._published < 0.9e9 / self.values['publish_rate']:
            self._published = stamp
            self._publish(arm, estimate)

    def _publish(self, arm: Arm, estimate: ArmEstimate) -> None:
        stamp, heard = time_message(estimate.stamp), self._listeners.heard()
        for topic, message in self._messages.items():
            if topic in heard:
                message.header.stamp = stamp
                for field, of_estimate in FIELDS[topic].items():
                    setattr(message, field, getattr(estimate, of_estimate).tolist())
                heard[topic].publish(message)
        if publisher := heard.get('external_wrench'):
            frame = self.values['wrench_frame']
            (wrench, near_singular), message = arm.wrench(estimate, frame), WrenchStamped()
            if near_singular:
                self._problems['near'] = 'near a singular posture: part of the wrench is not seen'
            message.header.stamp, message.header.frame_id = stamp, frame
            message.wrench.force, message.wrench.torque = (
                Vector3(x=x, y=y, z=z) for x, y, z in (wrench[:3], wrench[3:])
            )
            publisher.publish(message)

    def _tell(self, level: bytes, text: str, estimate: ArmEstimate | None = None) -> None:
        """Publish what is known of contact, by an estimate if there is one."""
        report, when = diagnostics.Report('contact'), self.get_clock().now().to_msg()
        report.find(level, text)
        if estimate is not None:
            when = time_message(estimate.stamp)
            report.values = {'link': estimate.link, 'log odds': estimate.log_odds}
            torques = zip(self._arm.joints, estimate.external_torque, strict=True)
            report.values |= {f'external torque {name}': torque for name, torque in torques}
        if level == WARN:
            self.get_logger().warning(f'event: {text}', throttle_duration_sec=QUIET)
        self._outputs['event'].publish(diagnostics.array_of(self, when, [report]))

    def _reports(self) -> list[diagnostics.Report]:
        report = diagnostics.Report('arm')
        for problem in self._problems.values():
            report.find(WARN, problem)
        self._problems.clear()
        silent = perf_counter() - self._latest
        if self._arm is None:
            report.find(ERROR, self._missing)
        elif not silent < SILENT:
            topic = self.resolve_topic_name(self.values['input_topic'])
            since = f'for {silent:.3g} s' if np.isfinite(silent) else 'yet'
            report.find(ERROR, f'no usable sample on {topic} {since}: nothing is published')
            if self._contact:
                self._contact = None
                self._tell(STALE, f'no usable sample {since}: contact is not known')
        elif self._estimate is not None:
            report.values['log odds of contact'] = self._estimate.log_odds
            report.values['contact'] = self._estimate.link or 'none'
        if self._arm is not None:
            report.values |= {f'samples {what}': n for what, n in self._arm.counters.items()}
        self._log.tell([report])
        return [report]

    def _prepare(self, values: Parameters, _: Mapping[str, Value]) -> Parameters:
        payload_of(values)  # raises; what can't change live is read-only in ROS
        return values

    def _adopt(self, values: Parameters) -> None:
        if self._arm is not None:
            self._arm.adopt(values)

    def _serve(self, name: str, _: Any, response: Trigger.Response) -> Trigger.Response:
        response.success = self._estimate is not None
        response.message = SERVICES[name] if response.success else 'there is no estimate yet'
        if response.success:
            getattr(self._arm, name)()
        self.get_logger().info(f'{name}: {response.message}')
        return response


def main(argv: list[str] | None = None) -> int:
    """Run the arm node."""
    return run_node('arm', ArmNode, argv)
