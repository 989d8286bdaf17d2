# SPDX-License-Identifier: Apache-2.0
"""A managed node whose transitions may fail but never end the process."""

from abc import abstractmethod
from collections.abc import Callable
import traceback
from typing import Any

from fhaosmo_ros.core.parameters.errors import ConfigurationError
from fhaosmo_ros.nodes.middleware.simulated_time import reject_negative_time
from lifecycle_msgs.srv import ChangeState
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.lifecycle import LifecycleNode, LifecycleState, TransitionCallbackReturn

SUCCESS, FAILURE = TransitionCallbackReturn.SUCCESS, TransitionCallbackReturn.FAILURE


class ManagedNode(LifecycleNode):
    """
    A managed node (ROS 2 lifecycle) that says why a transition failed.

    A transition fails if `configure`, `activate` or `deactivate` of a subclass raises. After a
    failed configure or activate, what it has made is destroyed again.
    """

    def __init__(self, name: str, **options: Any) -> None:
        super().__init__(name, **options)
        reject_negative_time(self)
        self._error: Exception | None = None
        # In rclpy 7.1 a transition that the state does not allow raises, and ends the spinning.
        service = self._service_change_state
        service.callback = self._guarded(service.callback)

    @abstractmethod
    def configure(self) -> None:
        """Make what the node needs; raise if it is not possible."""

    @abstractmethod
    def activate(self) -> None:
        """Begin to work."""

    @abstractmethod
    def deactivate(self) -> None:
        """Stop working; also called when the node is not active."""

    @abstractmethod
    def cleanup(self) -> None:
        """Destroy what `configure` has made, all or part of it."""

    @property
    def state(self) -> str:
        """Label of the state: unconfigured, inactive, active, finalized."""
        return str(self._state_machine.current_state[1])

    def start(self) -> None:
        """
        Configure and activate at once.

        Raises
        ------
        Exception
            What `configure` or `activate` raised.

        """
        for transition in (self.trigger_configure, self.trigger_activate):
            if transition() != SUCCESS:
                assert self._error is not None
                raise self._error

    def stop(self) -> None:
        """Finalize from whatever state."""
        if self.state in ('unconfigured', 'inactive', 'active'):
            self.trigger_shutdown()

    def on_configure(self, _: LifecycleState) -> TransitionCallbackReturn:
        """Unconfigured to inactive."""
        return self._attempt(self.configure, undo=self.cleanup)

    def on_activate(self, _: LifecycleState) -> TransitionCallbackReturn:
        """Inactive to active."""
        return self._attempt(self.activate, undo=self.deactivate)

    def on_deactivate(self, _: LifecycleState) -> TransitionCallbackReturn:
        """Active to inactive."""
        return self._attempt(self.deactivate)

    def on_cleanup(self, _: LifecycleState) -> TransitionCallbackReturn:
        """Inactive to unconfigured."""
        return self._attempt(self.cleanup)

    def on_shutdown(self, _: LifecycleState) -> TransitionCallbackReturn:
        """Any state to finalized."""
        return self._attempt(self.cleanup)

    def _attempt(
        self, action: Callable[[], None], undo: Callable[[], None] = lambda: None
    ) -> TransitionCallbackReturn:
        try:
            action()
        except Exception as error:
            self._error = error
            undo()
            return FAILURE
        return SUCCESS

    def _guarded(self, callback: Callable[..., Any]) -> Callable[..., Any]:
        def change_state(
            request: ChangeState.Request, response: ChangeState.Response
        ) -> ChangeState.Response:
            self._error = None
            before, wanted = self.state, request.transition.label or request.transition.id
            try:
                response = callback(request, response)
            except rclpy_implementation.RCLError:
                response.success = False
            if response.success:
                self.get_logger().info(f'{before} -> {self.state}')
            elif self._error is None:
                self.get_logger().warning(f'transition {wanted} is not possible while {before}')
            elif isinstance(self._error, ConfigurationError):
                self.get_logger().error(f'transition {wanted} failed: {self._error}')
            else:
                text = ''.join(traceback.format_exception(self._error))
                self.get_logger().error(f'transition {wanted} failed: {text}')
            return response

        return change_state
