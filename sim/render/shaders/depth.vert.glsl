#version 330
// The depth camera's view of the visuals and of the room (whose pose is the identity), with the projector's light.

uniform mat4 view;
uniform mat4 projector;  // world to the projector's clip space, rows

in vec3 in_corner;
in vec3 in_normal;
in vec3 in_scale;
in mat4 in_pose;

out vec4 projector_place;

void main() {
    vec4 world = vec4(in_corner * in_scale, 1.0) * in_pose;
    // Off the surface a little, so that a side that the projector just grazes does not shade itself in stripes.
    vec3 normal = normalize((vec4(in_normal / in_scale, 0.0) * in_pose).xyz);
    projector_place = (world + vec4(normal * 0.0015, 0.0)) * projector;
    gl_Position = world * view;
}
