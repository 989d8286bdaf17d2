# SPDX-License-Identifier: Apache-2.0
"""A managed node whose transitions may fail but never end the process."""

from collections.abc import Callable
from traceback import format_exception
from typing import Any

from fhaosmo_ros.core.parameters.errors import ConfigurationError
from fhaosmo_ros.nodes.middleware.node import BaseNode
from lifecycle_msgs.srv import ChangeState
from rclpy.lifecycle import LifecycleNodeMixin, LifecycleState, TransitionCallbackReturn

SUCCESS = TransitionCallbackReturn.SUCCESS
KINDS = ('publisher', 'subscription', 'service', 'timer')


class ManagedNode(LifecycleNodeMixin, BaseNode):
    """
    A managed node (ROS 2 lifecycle) that says why a transition failed.

    A subclass has the methods `configure`, `activate` and `deactivate`, which is also called when
    the node is not active; a transition fails if its method raises. All publishers, subscriptions,
    services and timers that were made since `configure` began are destroyed by the transition
    cleanup, and if `configure` fails.
    """

    def __init__(self, *arguments: Any, **options: Any) -> None:
        BaseNode.__init__(self, *arguments, **options)
        LifecycleNodeMixin.__init__(self)
        self._error: Exception | None = None
        self._lasting: set[Any] = set()
        service = next(s for s in self.services if s.service_name.endswith('/change_state'))
        self._rclpy_change_state, service.callback = service.callback, self._change_state

    @property
    def state(self) -> str:
        """One of unconfigured, inactive, active and finalized, and between two of them another."""
        return self._state_machine.current_state[1]  # type: ignore[no-any-return]

    def destroy_node(self) -> None:
        """
        Finalize and destroy the node, and its state machine, which rclpy 7.1 leaves.

        That would keep the node, and all that the middleware has for it, until the process ends;
        there Fast DDS may wait for ever.
        """
        if self.state != 'finalized':
            self.trigger_shutdown()
        super().destroy_node()
        self._state_machine.destroy_when_not_in_use()

    def cleanup(self) -> None:
        """Stop working and destroy what was made since `configure` began, all or part of it."""
        self.deactivate()
        for entity, kind in self._entities().items():
            if entity not in self._lasting:
                getattr(self, f'destroy_{kind}')(entity)

    def start(self) -> None:
        """Configure and activate at once; raise what `configure` or `activate` raised."""
        for transition in (self.trigger_configure, self.trigger_activate):
            if transition() != SUCCESS:
                assert self._error is not None
                raise self._error

    def on_configure(self, before: LifecycleState) -> TransitionCallbackReturn:
        """Unconfigured to inactive."""
        self._lasting = set(self._entities())
        return self._attempt(self.configure, undo=self.cleanup)

    def on_activate(self, before: LifecycleState) -> TransitionCallbackReturn:
        """Inactive to active."""
        return self._attempt(self.activate, undo=self.deactivate)

    def on_deactivate(self, before: LifecycleState) -> TransitionCallbackReturn:
        """Active to inactive."""
        return self._attempt(self.deactivate)

    def on_cleanup(self, before: LifecycleState) -> TransitionCallbackReturn:
        """Inactive to unconfigured, or any state to finalized."""
        unconfigured = before.label == 'unconfigured'
        return self._attempt(self.deactivate if unconfigured else self.cleanup)

    on_shutdown = on_cleanup

    def _attempt(
        self, action: Callable[[], None], undo: Callable[[], None] = lambda: None
    ) -> TransitionCallbackReturn:
        try:
            action()
        except Exception as error:
            self._error = error
            undo()
            return TransitionCallbackReturn.FAILURE
        return SUCCESS

    def _entities(self) -> dict[Any, str]:
        """Return what the node has in ROS, with the kind of each."""
        found = {entity: kind for kind in KINDS for entity in getattr(self, f'{kind}s')}
        clock = self.resolve_topic_name('/clock')  # rclpy's own, also made later
        return {e: kind for e, kind in found.items() if getattr(e, 'topic_name', '') != clock}

    def _change_state(self, request: ChangeState.Request, response: Any) -> Any:
        """Do what rclpy's service does, and log how it went."""
        self._error, log = None, self.get_logger()
        before, wanted = self.state, request.transition.label or request.transition.id
        try:
            response = self._rclpy_change_state(request, response)
        except RuntimeError:
            # Of rclpy 7.1, for what the state does not allow; it would end the spinning.
            response.success = False
        if response.success:
            log.info(f'{before} -> {self.state}')
        elif self._error is None:
            log.warning(f'transition {wanted} is not possible while {before}')
        else:
            defect = not isinstance(self._error, ConfigurationError)
            text = ''.join(format_exception(self._error)) if defect else self._error
            log.error(f'transition {wanted} failed: {text}')
        return response
