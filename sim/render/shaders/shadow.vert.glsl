#version 330
// A shadow map: the depth of the visuals seen from the lamp or the projector.

uniform mat4 view;

in vec3 in_corner;
in vec3 in_scale;
in mat4 in_pose;

void main() {
    gl_Position = (vec4(in_corner * in_scale, 1.0) * in_pose) * view;
}
