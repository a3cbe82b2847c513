/* Sends frames to `imgcal watch ADDRESS`. cc send_frames.c -lzmq -o send_frames (Debian: libzmq3-dev).
   send_frame is what a program of yours needs; main sends a square that moves, as four cameras. */
#define _POSIX_C_SOURCE 199309L
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <time.h>
#include <zmq.h>

enum { WIDTH = 640, HEIGHT = 480 };
static uint8_t pixels[HEIGHT][WIDTH];

/* Sends a frame of 8 bit, row by row from the top; seconds since 1970 at the middle of the exposure.
   Returns 0, or -1 with errno as ZeroMQ sets it. Never waits: where nobody reads, the frame is dropped. */
int send_frame(void *socket, const char *camera, double seconds, const void *frame, int width, int height)
{
    char header[512];
    int length = snprintf(header, sizeof header,
                          "{\"camera\": \"%s\", \"time\": %.6f, \"width\": %d, \"height\": %d, \"type\": \"uint8\"}",
                          camera, seconds, width, height);
    if (length < 0 || (size_t)length >= sizeof header)
        return -1;
    if (zmq_send(socket, header, (size_t)length, ZMQ_SNDMORE) < 0)
        return -1;
    return zmq_send(socket, frame, (size_t)width * (size_t)height, 0) < 0 ? -1 : 0;
}

int main(int count, char **arguments)
{
    static const char *cameras[] = {"cam01", "cam02", "cam03", "cam04"};
    const struct timespec pause = {0, 16666667};
    void *context = zmq_ctx_new(), *socket = zmq_socket(context, ZMQ_PUB);
    int snapshots = count > 2 ? atoi(arguments[2]) : 1000;
    if (count < 2 || zmq_bind(socket, arguments[1]) != 0) {
        fprintf(stderr, "usage: send_frames ADDRESS [SNAPSHOTS]: %s\n", zmq_strerror(zmq_errno()));
        return 1;
    }
    for (int snapshot = 0; snapshot < snapshots; snapshot++) {
        struct timespec now;
        clock_gettime(CLOCK_REALTIME, &now);
        for (int row = 0; row < HEIGHT; row++)
            for (int column = 0; column < WIDTH; column++)
                pixels[row][column] = abs(row - 240) < 5 && abs(column - 100 - snapshot % 400) < 5 ? 200 : 0;
        for (int camera = 0; camera < 4; camera++)
            send_frame(socket, cameras[camera], (double)now.tv_sec + 1e-9 * (double)now.tv_nsec, pixels, WIDTH, HEIGHT);
        nanosleep(&pause, NULL);
    }
    zmq_close(socket);
    zmq_ctx_term(context);
    return 0;
}
